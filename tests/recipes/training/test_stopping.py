"""How a recipe is stopped: Ctrl-C, SIGTERM, what it says and what it leaves behind."""

from __future__ import annotations

import contextlib
import os
import signal
import threading

import pytest

from recipes.training.stopping import stop_signals
from tests._toy import only_line, run


@pytest.mark.parametrize("fails", [False, True])
def test_handlers_come_back(fails):
    """Whoever sets others in the block, and however it ends; in another thread nothing is touched."""

    def handlers() -> list:
        return [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)]

    before, end = handlers(), pytest.raises(OSError) if fails else contextlib.nullcontext()
    with end, stop_signals(signal.SIG_IGN):
        assert handlers() == [signal.SIG_IGN] * 2
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        if fails:
            raise OSError
    assert handlers() == before
    with stop_signals():
        assert handlers() == before
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    assert handlers() == before
    seen = []

    def elsewhere() -> None:
        with stop_signals(signal.SIG_IGN):
            seen.extend(handlers())

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert seen == before


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_training_finishes_its_step_and_says_how_to_go_on(toy, number, code, tmp_path, capsys):
    steps, before = [], [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)]

    def act(cfg):
        for step in toy.command.until_stopped(range(cfg.steps)):
            if step == 1:
                os.kill(os.getpid(), number)
            steps.append(step)
        assert toy.command.stop_requested()
        (tmp_path / "my run" / "checkpoints" / "2").mkdir(parents=True)
        raise toy.command.Stopped(f"after {len(steps)} steps")

    toy.act = act
    assert run(toy, "steps=100", "hydra.run.dir=my run") == code
    assert steps == [0, 1]
    line = only_line(capsys)
    assert line.startswith("stopped after 2 steps; go on with: python -m toy ")
    assert line.endswith(" 'resume=my run'")
    assert [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)] == before


def test_ctrl_c_before_the_first_step_ends_at_once_and_leaves_no_folder(toy, tmp_path, capsys):
    def act(cfg):
        os.kill(os.getpid(), signal.SIGINT)
        pytest.fail("it goes on")

    toy.act = act
    assert run(toy) == 130
    assert only_line(capsys) == "stopped before anything was done"
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(("again", "steps"), [(signal.SIGINT, 0), (signal.SIGTERM, 1)])
def test_a_second_ctrl_c_ends_at_once_and_a_second_sigterm_does_not(toy, again, steps, capsys):
    done = []

    def act(cfg):
        for _ in toy.command.until_stopped(range(cfg.steps)):
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), again)
            done.append(1)
        raise toy.command.Stopped("after a step")

    toy.act = act
    assert run(toy) in (130, 143)
    assert len(done) == steps
    assert only_line(capsys).startswith("stopped after" if steps else "ended at once")


def test_writing_a_file_is_not_disturbed(toy, capsys):
    done = []

    def act(cfg):
        with toy.command.undisturbed():
            os.kill(os.getpid(), signal.SIGTERM)
            done.append("written")
        pytest.fail("it goes on")

    toy.act = act
    assert run(toy) == 143
    assert done == ["written"]
    assert only_line(capsys).startswith("ended at once; ")


def test_a_request_of_the_last_command_is_forgotten(toy):
    def act(cfg):
        os.kill(os.getpid(), signal.SIGINT)

    toy.act = act
    assert run(toy) == 130
    counted = []
    toy.act = lambda cfg: counted.extend(toy.command.until_stopped(range(cfg.steps)))
    assert run(toy) == 0
    assert counted == [0, 1, 2]
