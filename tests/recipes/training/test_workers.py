"""Workers of Ray: what they are sent, what comes back, and what a training says that loses one."""

from __future__ import annotations

import contextlib
import copy
import functools
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict

from recipes.mo_ppo import mo_ppo
from recipes.pd_morl import pd_morl
from recipes.training import on_policy
from recipes.training.cluster import _wait_for_cpus, join_cluster
from recipes.training.ppo import NoiseScale, make_policy
from recipes.training.task import make_worker_env
from recipes.training.validation import ConfigurationError, check_surroundings
from recipes.training.workers import (
    WorkerCollector,
    WorkerEnv,
    WorkerLost,
    Workers,
    _reason,
    worker_seed,
)
from tests._command import run_here
from tests._mo_ppo import TINY
from tests._workers import TWO, configuration, needs_ray, task_and_policy
from torchrl_morl.deploy import load_policy
from torchrl_morl.modules import make_actor
from torchrl_morl.testing import VectorRewardMockEnv


def test_seeds_of_workers_differ():
    seeds = {
        worker_seed(*key) for key in ((s, w, f) for s in (0, 1) for w in (0, 1) for f in (0, 96))
    }
    assert len(seeds) == 8
    assert all(0 <= seed < 2**31 for seed in seeds)
    assert worker_seed(0, 1, 96) == worker_seed(0, 1, 96)


def test_noise_is_sent_with_the_policy_and_is_no_weight():
    sigma = torch.tensor([0.5, 0.25])
    actor = make_actor(
        VectorRewardMockEnv(2).action_spec, in_features=5, num_cells=(4,), in_keys=("observation",)
    )
    noisy, policy = make_policy(actor, sigma)
    names = {name.rsplit(".", 1)[-1] for name in policy.state_dict()}
    assert "sigma" not in names
    assert "sigma" not in str(TensorDict.from_module(noisy))
    weights = TensorDict.from_module(policy).data.clone()
    torch.testing.assert_close(weights["noise", "sigma"], sigma)
    for other in (copy.deepcopy(policy), pickle.loads(pickle.dumps(policy)), policy):
        weights["noise", "sigma"] = torch.tensor([0.125, 1.0])
        TensorDict.from_module(other).data.update_(weights)
        scale = other(TensorDict(observation=torch.zeros(3, 5), batch_size=[3]))["scale"]
        torch.testing.assert_close(scale, torch.tensor([[0.125, 1.0]]).expand(3, 2))
    assert isinstance(policy.noise, NoiseScale)


def test_without_ray_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"collector\.backend: ray is not installed: pip install"):
        check_surroundings(mo_ppo.Config, {"collector": {"backend": "ray"}})


def test_the_same_seed_gives_a_worker_the_same_drives(tmp_path):
    cfg = configuration()
    task, _, _, policy = task_and_policy(cfg, tmp_path)
    first, again, other = (
        WorkerEnv(task.make_env, seed, 2, 1)().rollout(5, policy, break_when_any_done=False)
        for seed in (3, 3, 4)
    )
    assert first.shape == (2, 5)
    for key in ("observation", "preference", "noisy_action"):
        assert torch.equal(first[key], again[key]), key
        assert not torch.isclose(first[key], other[key]).all(), key


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (
            ("collector.num_workers=2",),
            "collector.num_workers must be 1 with collector.backend=direct",
        ),
        (
            ("collector.worker_cpus=2",),
            "collector.worker_cpus must be 1 with collector.backend=direct, where the process of the "
            "training collects, got 2: give collector.backend=ray.",
        ),
        (
            ("collector.ray_address=auto",),
            "collector.ray_address must be null with collector.backend=direct, where the process of "
            "the training collects, got auto: give collector.backend=ray.",
        ),
        (
            ("collector.backend=ray", "collector.num_workers=3"),
            "collector.num_workers must divide env.num_envs, 4, got 3.",
        ),
        (
            ("collector.backend=ray", "collector.num_workers=2", "preference.num_segments=3"),
            "preference.num_segments must be at most env.num_envs of each worker, 2, got 3.",
        ),
    ],
)
def test_refuses_what_workers_cannot_share(overrides, line, tmp_path):
    with pytest.raises(ConfigurationError) as refused:
        run_here(
            mo_ppo.main, "preset=nothing", *TINY, *overrides, f"hydra.run.dir={tmp_path / 'run'}"
        )
    assert line in str(refused.value)
    assert not (tmp_path / "run").exists()


@needs_ray
def test_a_cluster_that_is_not_there_is_one_line(monkeypatch):
    import ray

    def init(**arguments):
        assert arguments["address"] == "nowhere:6379"
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise Exception("The current node timed out\nduring startup.")

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(ray, "init", init)
    with pytest.raises(ConnectionError) as refused:
        join_cluster("nowhere:6379", 1, 1)
    line = "no cluster of Ray at nowhere:6379: The current node timed out during startup."
    assert str(refused.value) == line
    # Ray's own handler of SIGTERM is gone.
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """One for all tests: workers join it, and it starts but once."""
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install ray")
    assert join_cluster(None, 2, 1)
    yield
    ray.shutdown()


@pytest.fixture
def collecting(cluster, tmp_path):
    """Makes workers, and ends them."""
    made = []

    def make(*overrides: str):
        cfg = configuration(*overrides)
        task, sigma, noisy, policy = task_and_policy(cfg, tmp_path)
        made.append(Workers(cfg, task, policy))
        return made[-1], sigma, noisy, policy

    yield make
    for workers in made:
        workers.shutdown()


@needs_ray
def test_a_batch_is_that_of_one_process_shared_among_workers(collecting):
    workers, sigma, noisy, policy = collecting("env.max_episode_steps=3")
    batches = iter(workers)
    data = next(batches)
    assert data.shape == (4, 8)
    ids = data["collector", "traj_ids"]
    assert ids.min() >= 0
    # Two environments each, whose first episodes are 0 and 1 at both; made unique by the worker.
    assert ids[:, 0].tolist() == [0, 2, 1, 3]
    assert not set(ids[:2].flatten().tolist()) & set(ids[2:].flatten().tolist())
    for key in ("observation", "preference", "noisy_action"):
        first, second = data[key][:2, 0], data[key][2:, 0]
        assert not torch.isclose(first.unsqueeze(1), second).all(-1).any(), key
    # The second batch is of the policy as it is then, noise included.
    with torch.no_grad():
        sigma.copy_(torch.tensor([0.5, 0.01]))
        for parameter in policy.parameters():
            parameter.add_(0.01)
        data = next(batches)
        likelihood = noisy.log_prob(data.clone())
    torch.testing.assert_close(likelihood, data["noisy_action_log_prob"])
    torch.testing.assert_close(data["scale"][0, 0], sigma)
    assert workers.frames == 64
    # One that dies is named.
    assert len(set(workers.names)) == 2
    os.kill(int(workers.names[1].split()[1]), signal.SIGKILL)
    with pytest.raises(WorkerLost) as lost:
        next(batches)
    line = str(lost.value)
    assert line.startswith(f"worker 2 of 2 ({workers.names[1]}) has died") and "\n" not in line


@needs_ray
def test_a_worker_that_cannot_begin_says_why(collecting):
    workers, *_ = collecting("collector.num_workers=1")
    function, arguments = workers.problem.make_env.func, workers.problem.make_env.args
    assert function is make_worker_env
    elsewhere = OmegaConf.merge(arguments[0], {"env": {"scene": "on_another_machine.yaml"}})
    object.__setattr__(
        workers.problem, "make_env", functools.partial(function, elsewhere, *arguments[1:])
    )
    with pytest.raises(
        WorkerLost, match=r"^a worker has not begun: .*on_another_machine.* no such file"
    ):
        iter(workers)


@needs_ray
def test_more_cpus_than_the_cluster_has_are_refused(collecting):
    workers, *_ = collecting("collector.worker_cpus=500")
    with pytest.raises(ValueError, match=r"num_workers=2 of .*worker_cpus=500 do not fit into"):
        iter(workers)


@needs_ray
def test_a_busy_cluster_is_waited_for_and_then_named(collecting, monkeypatch):
    import ray

    monkeypatch.setattr("recipes.training.cluster.PATIENCE", 1.0)
    monkeypatch.setattr(
        ray._private.state, "available_resources_per_node", lambda: {"a": {"CPU": 1.0}}
    )
    with pytest.raises(
        ConnectionError, match=r"cluster is busy: its machines have 1 CPUs free after 1 seconds"
    ):
        iter(collecting()[0])


def machines(totals: list[float], free: list[float]) -> SimpleNamespace:
    """What Ray says of a cluster; a machine whose CPUs are all taken names none."""
    left = {str(one): {"CPU": cpus} if cpus else {} for one, cpus in enumerate(free)}
    return SimpleNamespace(
        nodes=lambda: [{"Alive": True, "Resources": {"CPU": cpus}} for cpus in totals],
        available_resources=lambda: {"CPU": sum(free)},
        _private=SimpleNamespace(state=SimpleNamespace(available_resources_per_node=lambda: left)),
    )


@pytest.mark.parametrize(
    ("free", "workers", "cpus", "fits"),
    [
        ([4.0, 0.0], 1, 4, True),
        ([2.0, 2.0], 1, 4, False),  # enough, but on no machine
        ([3.0, 3.0], 2, 3, True),
        ([3.0, 3.0], 3, 2, False),
        ([4.0, 2.0], 3, 2, True),
    ],
)
def test_a_worker_has_its_cpus_on_one_machine(free, workers, cpus, fits, monkeypatch):
    monkeypatch.setattr("recipes.training.cluster.PATIENCE", 0.0)
    ray = machines([4.0, 4.0], free)
    if fits:
        _wait_for_cpus(ray, workers, cpus)
        return
    with pytest.raises(ConnectionError) as busy:
        _wait_for_cpus(ray, workers, cpus)
    each = ", ".join(f"{one:.0f}" for one in free)
    room = sum(int(one) // cpus for one in free)
    assert str(busy.value) == (
        f"the cluster is busy: its machines have {each} CPUs free after 0 seconds, room for {room} of "
        f"collector.num_workers={workers} with collector.worker_cpus={cpus}."
    )


def test_a_cluster_without_machines_is_not_called_too_small():
    """Those that are too busy to answer Ray count as dead."""
    with pytest.raises(ConnectionError, match="has no machine that answers: start it anew"):
        _wait_for_cpus(machines([], []), 1, 1)


def test_machines_that_never_have_room_are_refused():
    with pytest.raises(ValueError, match=r"num_workers=1 of .*worker_cpus=5 do not fit into"):
        _wait_for_cpus(machines([4.0, 4.0], [4.0, 4.0]), 1, 5)


def descendants(process: int) -> set[int]:
    """Processes that a process has started, and those that they have."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
    found: set[int] = set()
    while new := {one for one, parent in parents.items() if parent in found | {process}} - found:
        found |= new
    return found


def eventually(condition: Callable[[], bool], seconds: float = 240) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.1)
    return condition()


@needs_ray
@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_training_that_ends_leaves_no_process(number, tmp_path):
    """SIGTERM, which Ray would take for itself, saves first; SIGKILL leaves a cluster without owner."""
    folder = tmp_path / "run"
    tiny = [one for one in TINY if "total_frames" not in one and "interval" not in one]
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "recipes.mo_ppo.mo_ppo", "preset=nothing", *tiny, *TWO),
            *("collector.total_frames=1_000_000", f"hydra.run.dir={folder}"),
        ],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    steps = folder / "log_csv/scalars/train/loss_critic.csv"
    assert eventually(steps.exists)
    started = descendants(process.pid)
    assert len(started) > 2
    process.send_signal(number)
    _, errors = process.communicate(timeout=240)
    assert eventually(lambda: not any(Path(f"/proc/{one}").exists() for one in started))
    if number == signal.SIGTERM:
        assert process.returncode == 143
        last = errors.splitlines()[-1]
        assert last.startswith("stopped after ") and "go on with: python -m recipes.mo_ppo" in last
        assert "Traceback" not in errors
        assert list((folder / "checkpoints").iterdir())


def scalars(folder, name: str) -> list[str]:
    return (folder / "log_csv/scalars/train" / f"{name}.csv").read_text().split()


@needs_ray
def test_mo_ppo_loses_a_worker_and_goes_on(cluster, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    arguments = ("preset=nothing", *TINY, *TWO, f"hydra.run.dir={folder}")
    started, start = [], Workers._start

    def recorded(workers):
        started.append(workers)
        start(workers)

    plain = on_policy.logs.log_metrics

    def kill(loggers, metrics, frames):
        plain(loggers, metrics, frames)
        if frames == 96 and len(started) == 1:
            os.kill(int(started[0].names[0].split()[1]), signal.SIGKILL)

    monkeypatch.setattr(Workers, "_start", recorded)
    monkeypatch.setattr(on_policy.logs, "log_metrics", kill)
    with pytest.raises(WorkerLost, match=r"worker 1 of 2 .* has died.*; 96 steps are saved"):
        run_here(mo_ppo.main, *arguments)
    run_here(mo_ppo.main, f"resume={folder}")
    names = sorted(path.name for path in (folder / "policies").iterdir())
    assert names == ["000000064", "000000128"]
    steps = [row.split(",")[0] for row in scalars(folder, "loss_critic")]
    assert steps == ["32", "64", "96", "128"]
    assert (
        load_policy(folder / "policies" / names[-1]).card["config"]["collector"]["num_workers"] == 2
    )
    # What came after was collected in new episodes, of other seeds.
    assert [workers.frames for workers in started] == [96, 128]


def errors_of_ray() -> dict[str, Exception]:
    from ray import exceptions as raised

    return {
        "lost": raised.ObjectLostError("abc", None, "somewhere"),
        "owner": raised.OwnerDiedError("abc", None, "somewhere"),
        "full": raised.ObjectStoreFullError("no room"),
        "memory": raised.OutOfMemoryError("a node is low on memory\nTop 10 processes"),
        "raylet": raised.LocalRayletDiedError(),
        "system": raised.RaySystemError("connection refused\nsecond line"),
        "away": raised.ActorUnavailableError("the network is away", None),
        "died": raised.ActorDiedError(),
        "task": raised.RayTaskError("next", "traceback", raised.ObjectLostError("a", None, "b")),
    }


@needs_ray
@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("lost", "has lost what it was sending (ObjectLostError): a machine is gone or cut off"),
        ("owner", "has lost what it was sending (OwnerDiedError): a machine is gone or cut off"),
        (
            "full",
            "has failed (ObjectStoreFullError): a machine is out of memory or disk, free some or take "
            "a smaller collector.frames_per_batch",
        ),
        (
            "memory",
            "has failed (OutOfMemoryError): a machine is out of memory or disk, free some or take a "
            "smaller collector.frames_per_batch",
        ),
        (
            "raylet",
            "has failed (LocalRayletDiedError: The task's local raylet died. Check raylet.out for more "
            "information.): start the cluster of Ray anew",
        ),
        (
            "system",
            "has failed (RaySystemError: System error: connection refused): start the cluster of Ray anew",
        ),
        ("away", "cannot be reached: its machine or the network is gone"),
        ("died", "has died: killed, out of memory, or its machine is gone"),
    ],
)
def test_whatever_ray_raises_is_one_line_that_says_what_to_do(kind, line):
    assert _reason(errors_of_ray()[kind]) == line


@needs_ray
def test_what_a_worker_itself_could_not_fetch_is_one_line():
    line = _reason(errors_of_ray()["task"])
    assert line.startswith("has failed: ObjectLostError: Failed to retrieve") and "\n" not in line


class Here:
    """A worker in this process, with the calls that the learner makes of one of Ray."""

    def __init__(self, workers: Workers, seed: int) -> None:
        cfg, policy = workers.cfg.collector, copy.deepcopy(workers.policy)
        env = WorkerEnv(workers.problem.make_env, seed, 2, 1, workers.transform)()
        batches = iter(WorkerCollector(env, policy, frames_per_batch=cfg.frames_per_batch // 2))
        weights = TensorDict.from_module(policy).data
        self.next = SimpleNamespace(remote=lambda: next(batches))
        self.update_policy_weights_ = SimpleNamespace(remote=weights.update_)


@needs_ray
@pytest.mark.parametrize(
    ("kind", "call"), [("lost", "get"), ("full", "put"), ("system", "shutdown"), ("away", "get")]
)
def test_whatever_ray_raises_keeps_what_was_learned(tmp_path, monkeypatch, kind, call):
    """A cluster that is gone fails in the end of its workers once more, which hides nothing."""
    import ray

    error, folder = errors_of_ray()[kind], tmp_path / "run"

    def fail(*_: object) -> None:
        raise error

    def start(workers: Workers) -> None:
        workers._collector = SimpleNamespace(
            remote_collectors=[Here(workers, seed) for seed in (3, 4)], shutdown=lambda: None
        )
        if call == "shutdown":
            workers._collector.shutdown = fail

    monkeypatch.setattr(Workers, "_start", start)
    monkeypatch.setattr(ray, "put", lambda value: value)
    monkeypatch.setattr(ray, "get", lambda value: value)
    log = on_policy.logs.log_metrics

    def then_fail(loggers, metrics, frames):
        log(loggers, metrics, frames)
        if frames == 96:
            monkeypatch.setattr(ray, "get" if call == "shutdown" else call, fail)

    monkeypatch.setattr(on_policy.logs, "log_metrics", then_fail)
    tiny = [one for one in TINY if "evaluation.interval" not in one]
    with pytest.raises(WorkerLost) as lost:
        run_here(mo_ppo.main, "preset=nothing", *tiny, *TWO, f"hydra.run.dir={folder}")
    line = str(lost.value)
    assert line.endswith("; 96 steps are saved") and "\n" not in line
    who = "the learner has" if call == "put" else "worker 1 of 2 "
    assert line.startswith(who) and _reason(error) in line
    names = [path.name for path in (folder / "checkpoints").iterdir()]
    assert names == ["checkpoint-000000000096"]


@needs_ray
def test_pd_morl_trains_with_workers(cluster, tmp_path):
    run_here(
        pd_morl.main,
        *TWO,
        "compute.compile=false",
        "network.num_cells=[16,16]",
        "env.num_envs=4",
        "collector.frames_per_batch=16",
        "collector.init_random_frames=32",
        "collector.total_frames=96",
        "replay_buffer.size=96",
        "replay_buffer.batch_size=16",
        "evaluation.interval=96",
        "evaluation.episodes=2",
        "logger.backends=[csv]",
        "logger.interval=16",
        f"hydra.run.dir={tmp_path / 'run'}",
    )
    assert (tmp_path / "run" / "policies" / "000000096").exists()
    assert len(scalars(tmp_path / "run", "loss_qvalue")) == 4
