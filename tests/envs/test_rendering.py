from __future__ import annotations

import os
import pickle
import subprocess
import sys

import mujoco
import numpy as np
import pytest
import torch
from mujoco.batch import Batch
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.record import CSVLogger, VideoRecorder

from envs import Camera, NavigationEnv
from envs.rendering import Renderer, gl_context_type
from torchrl_morl.evaluation import VideoLogger, draw_preference, write_video
from torchrl_morl.evaluation.overlay import BAR_COLORS
from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.transforms import PreferenceOverlay, PreferenceSampler

SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})
SMALL = {"render_width": 192, "render_height": 108}

try:
    gl_context_type()
    NO_GL = ""
except RuntimeError as error:
    NO_GL = str(error)
needs_gl = pytest.mark.skipif(bool(NO_GL), reason=NO_GL)


def make_env(**kwargs) -> NavigationEnv:
    kwargs = {"scene": "showcase", "num_threads": 1, "seed": 0, **SMALL, **kwargs}
    env = NavigationEnv(**kwargs)
    env.reset()
    return env


def drive(env: NavigationEnv, steps: int, action=(0.5, 0.0)) -> None:
    data = env.reset()
    for _ in range(steps):
        data = env.step(data.set("action", torch.tensor([action] * env.num_envs)))["next"]


# --- render ------------------------------------------------------------------------------------


@needs_gl
@pytest.mark.parametrize("camera", ["top", "chase", "overview", Camera((4.5, 0.0, 0.0))])
@pytest.mark.parametrize("scene", ["showcase", "empty", "corridor"])
def test_picture_shows_something(camera, scene):
    env = make_env(num_envs=2, scene=scene)
    frames = env.render(camera=camera)
    assert frames.shape == (2, 108, 192, 3)
    assert frames.dtype == torch.uint8
    assert frames.float().std() > 5
    env.close()


@needs_gl
@pytest.mark.parametrize("camera", ["top", "chase"])
@pytest.mark.parametrize("drive_name", ["planar", "wheels"])
def test_picture_changes_with_the_robot(camera, drive_name):
    env = make_env(drive=drive_name)
    before = env.render(camera=camera)
    assert torch.equal(before, env.render(camera=camera))
    drive(env, 3)
    assert (env.render(camera=camera) != before).any(-1).sum() > 20
    env.close()


@needs_gl
def test_each_environment_has_its_own_boxes():
    env = make_env(num_envs=2)
    snapshot = env.reset()
    snapshot["scene", "boxes"][1, :, 3:] *= 1.5
    env.reset(snapshot, set_state=True)
    # One view for both, since the boxes also change what the picture is framed around.
    view = Camera((4.5, 0.0, 0.0), height=6.0)
    grey = torch.tensor([153, 153, 158]).float()
    frames = env.render(camera=view, width=320, height=180).float()
    chroma = (frames - grey).abs().amax(-1)
    area = (chroma < 12).sum((-1, -2)).float()
    assert area[1] / area[0] == pytest.approx(2.25, rel=0.1)
    env.close()


@needs_gl
@pytest.mark.parametrize("scene", ["static", "moving_human", "showcase"])
@pytest.mark.parametrize("size", [(320, 180), (120, 240)])
def test_top_view_clips_nothing(scene, size):
    """No obstacle, human, goal or robot touches the border: it shows nothing but the floor."""
    env = make_env(num_envs=4, scene=scene)
    frames = env.render(width=size[0], height=size[1]).float()
    border = torch.cat([frames[:, 0], frames[:, -1], frames[:, :, 0], frames[:, :, -1]], 1)
    assert border.min() > 200
    assert frames.min() < 80
    env.close()


@needs_gl
def test_top_view_follows_a_robot_that_leaves():
    env = make_env()
    still = env._camera("top", 0, 16 / 9)
    drive(env, 3)
    assert env._camera("top", 0, 16 / 9) == still
    env._view["qpos"][0, :2] = torch.tensor([-20.0, 0.0])
    assert env._camera("top", 0, 16 / 9).height > 2 * still.height
    env.close()


@needs_gl
def test_trails_and_ids():
    env = make_env(num_envs=3)
    blue = (0.0, 0.2, 1.0)
    path = torch.tensor([[0.0, -1.0], [4.0, -1.0], [float("nan"), 0.0], [8.0, -1.0], [8.0, -1.0]])
    plain, trail = env.render(ids=[2]), env.render(ids=[2], trails=[(path, blue)])
    assert trail.shape[0] == 1
    painted = (trail.float() - plain.float()).abs().amax(-1) > 40
    assert painted.any(1).sum() > 0.5 * 192  # columns: the path is 8 of at most 11 m long
    assert painted.any(2).sum() < 8  # rows: it is straight
    # Trails belong to one picture.
    assert torch.equal(env.render(ids=[2]), plain)
    with pytest.raises(ValueError, match="A trail is"):
        env.render(trails=[(path[:, :1], blue)])
    with pytest.raises(ValueError, match="more points"):
        env.render(trails=[(torch.rand(30_000, 2) * 1000, blue)])
    env.close()


def test_trails_are_simplified():
    from envs.rendering import _simplify

    angle = torch.linspace(0, 3.14, 200).double().numpy()
    arc = np.stack((np.cos(angle), np.sin(angle)), -1)
    short = _simplify(np.repeat(arc, 5, axis=0), 0.01)
    assert len(short) < 20
    assert (short[[0, -1]] == arc[[0, -1]]).all()
    middles = (short[1:] + short[:-1]) / 2
    assert np.abs(np.linalg.norm(middles, axis=-1) - 1).max() < 0.02
    there_and_back = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    assert _simplify(there_and_back, 0.01).tolist() == [[0, 0], [2, 0], [0, 0]]
    assert len(_simplify(arc[:1], 0.01)) == 1


@needs_gl
def test_arguments_are_checked():
    env = make_env(num_envs=2)
    with pytest.raises(ValueError, match="Unknown camera 'side'"):
        env.render(camera="side")
    with pytest.raises(ValueError, match=r"ids must be in 0 \.\.\. 1"):
        env.render(ids=[2])
    with pytest.raises(ValueError, match="needs names"):
        env.render(preference=[0.5, 0.5])
    with pytest.raises(ValueError, match="render_width"):
        make_env(render_width=0)
    charted = env.render(preference=torch.eye(2), names=SPACE.tunable, width=320, height=180)
    assert (charted[0] != charted[1]).any()
    env.close()


@needs_gl
def test_sizes_change_and_close_is_final_only_for_the_memory():
    env = make_env()
    first = env.render()
    assert env.render(width=64, height=200).shape == (1, 200, 64, 3)
    assert torch.equal(env.render(), first)
    env._close_renderer()
    assert torch.equal(env.render(), first)
    env.close()
    assert env._renderer is None


@needs_gl
def test_model_cameras_of_any_batch():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><light pos='0 0 3'/><geom size='.3'/>"
        "<camera name='front' pos='0 -2 0' xyaxes='1 0 0 0 0 1'/></worldbody></mujoco>"
    )
    renderer = Renderer(Batch(model, 1, 1), samples=0)
    assert renderer.render(0, "front", 40, 30).std() > 5
    with pytest.raises(ValueError, match=r"the model has \['front'\]"):
        renderer.render(0, "back", 40, 30)
    renderer.close()


@needs_gl
def test_pickle_leaves_the_renderer_behind():
    env = make_env(num_envs=2, scene="static", from_pixels=True)
    frames = env.render()
    twin = pickle.loads(pickle.dumps(env))
    assert twin._renderer is None
    assert torch.equal(twin.render(), frames)
    twin.close()
    env.close()


def test_rendering_costs_nothing_until_used():
    env = make_env()
    assert env._renderer is None
    assert "pixels" not in env.observation_spec.keys()


FORK = """
import multiprocessing, sys
from envs import NavigationEnv

def draw():
    env = NavigationEnv(num_threads=1, render_width=64, render_height=48, seed=0)
    env.reset()
    return env, env.render()

def child(inherited):
    for one in (inherited.render, draw):  # the parent's renderer, and one of its own
        try:
            one()
        except RuntimeError as error:
            print(error, flush=True)
    inherited.close()
    del inherited

if __name__ == "__main__":
    inherited, _ = draw()
    # In a row: fork fails and ends, spawn draws, and the parent goes on.
    for method, target, arguments in (("fork", child, (inherited,)), ("spawn", draw, ())):
        process = multiprocessing.get_context(method).Process(target=target, args=arguments)
        process.start()
        process.join(100)
        print(method, process.exitcode, flush=True)
        process.kill()
    print(bool((inherited.render() > 0).any()), flush=True)
"""


@needs_gl
def test_a_forked_process_is_told_to_spawn(tmp_path):
    script = tmp_path / "fork.py"
    script.write_text(FORK)
    run = subprocess.run(
        [sys.executable, str(script)],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    refusal, again, *rest = run.stdout.splitlines()
    assert refusal == again, run.stdout + run.stderr
    assert refusal.startswith("This process was forked after its parent had drawn a picture")
    assert "mp_start_method='spawn'" in refusal
    assert rest == ["fork 0", "spawn 0", "True"], run.stderr


def test_message_without_a_backend():
    """MuJoCo is imported first, and then finds no OpenGL."""
    script = (
        "import mujoco, os\n"
        "os.environ['MUJOCO_GL'] = 'disable'\n"
        "from envs import NavigationEnv\n"
        "env = NavigationEnv()\n"
        "env.reset()\n"
        "env.render()\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert result.returncode == 1
    message = result.stderr.strip().splitlines()[-1]
    assert "No OpenGL backend works (MUJOCO_GL='disable'): rendering is switched off" in message
    assert "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri" in message


def test_a_failed_backend_is_undone(monkeypatch):
    """PyOpenGL can be imported for one platform only: a failure must not spoil the next try."""
    from envs import rendering

    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setenv("MUJOCO_GL", "on")
    monkeypatch.setattr(rendering, "_backends", lambda: ("nonsense", "neither"))
    loaded = set(sys.modules)
    with pytest.raises(RuntimeError, match=r"nonsense: ModuleNotFoundError.*neither: ModuleNot"):
        rendering.gl_context_type.__wrapped__()
    assert set(sys.modules) == loaded
    assert "PYOPENGL_PLATFORM" not in os.environ
    assert os.environ["MUJOCO_GL"] == "on"


# --- pixels ------------------------------------------------------------------------------------


@needs_gl
@pytest.mark.parametrize("num_envs", [1, 3])
def test_from_pixels_specs(num_envs):
    env = make_env(num_envs=num_envs, from_pixels=True, render_width=32, render_height=24)
    assert env.observation_spec["pixels"].shape == (num_envs, 24, 32, 3)
    check_env_specs(env)
    env.close()


@needs_gl
def test_partial_reset_draws_only_what_it_needs(monkeypatch):
    env = make_env(num_envs=3, scene="static", from_pixels=True)
    data = env.rand_step(env.reset())["next"]
    drawn = []
    render = Renderer.render
    monkeypatch.setattr(
        Renderer,
        "render",
        lambda self, index, *args: drawn.append(index) or render(self, index, *args),
    )
    data["_reset"] = torch.tensor([[False], [True], [False]])
    result = env.reset(data.clone())["pixels"]
    assert drawn == [1]
    assert torch.equal(result[[0, 2]], data["pixels"][[0, 2]])
    assert (result[1] != data["pixels"][1]).any()
    env.close()


# --- overlay -----------------------------------------------------------------------------------


def bar_lengths(frame: torch.Tensor, count: int) -> list[int]:
    """Length of the bars in a frame, pixels."""
    colors = torch.tensor(BAR_COLORS[:count])
    return [int((frame == color).all(-1).sum(-1).max()) for color in colors]


def test_bars_are_proportional():
    frames = torch.full((3, 180, 320, 3), 90, dtype=torch.uint8)
    preference = torch.tensor([[1.0, 0.0, 0.0], [0.5, 0.25, 0.25], [0.0, 0.2, 0.8]])
    out = draw_preference(frames, preference, ("demo", "distance", "efficiency"))
    assert (frames == 90).all()
    assert (out[:, 90:] == 90).all()
    full = bar_lengths(out[0], 3)[0]
    assert full > 30
    for frame, row in zip(out, preference, strict=True):
        expected = [round(share * full) for share in row.tolist()]
        assert bar_lengths(frame, 3) == pytest.approx(expected, abs=1)


def test_overlay_checks_its_input():
    frames = torch.zeros(2, 120, 200, 3, dtype=torch.uint8)
    with pytest.raises(ValueError, match="too small"):
        draw_preference(frames[:, :20, :20], torch.ones(2) / 2, ("distance", "efficiency"))
    with pytest.raises(ValueError, match="uint8"):
        draw_preference(frames.float(), torch.ones(2) / 2, ("distance", "efficiency"))
    with pytest.raises(ValueError, match="one entry for each"):
        draw_preference(frames, torch.ones(3) / 3, ("distance", "efficiency"))
    with pytest.raises(ValueError, match="does not fit frames"):
        draw_preference(frames, torch.ones(3, 2) / 2, ("distance", "efficiency"))
    one = draw_preference(frames, torch.tensor([0.3, 0.7]), ("distance", "efficiency"))
    assert torch.equal(one[0], one[1])


@needs_gl
def test_overlay_without_preferences():
    env = TransformedEnv(make_env(from_pixels=True), PreferenceOverlay(SPACE))
    with pytest.raises(KeyError, match="after the PreferenceSampler"):
        env.reset()
    env.close()


@needs_gl
def test_overlay_shows_the_preference_of_every_environment():
    base = make_env(num_envs=2, from_pixels=True, scene="static", max_episode_steps=2)
    env = TransformedEnv(base, Compose(PreferenceSampler(SPACE, seed=0), PreferenceOverlay(SPACE)))
    check_env_specs(env)
    data = env.reset()
    full = bar_lengths(draw_preference(data["pixels"][0], [1.0, 0.0], SPACE.tunable), 1)[0]

    def check(data):
        for frame, preference in zip(data["pixels"], data["preference"], strict=True):
            expected = (preference * full).tolist()
            assert bar_lengths(frame, 2) == pytest.approx(expected, abs=1.01)

    check(data)
    data = env.rand_step(data)["next"]
    check(data)
    data["_reset"] = torch.tensor([[True], [False]])
    kept = data["pixels"][1].clone()
    data = env.reset(data.exclude("preference"))
    assert torch.equal(env.transform[1]._last["pixels"][1], kept)
    assert torch.equal(data["pixels"][1], kept)
    check(data[:1])
    env.close()


# --- video -------------------------------------------------------------------------------------


@needs_gl
@pytest.mark.parametrize(("num_envs", "video_format"), [(1, "mp4"), (4, "gif")])
def test_video_recorder_end_to_end(tmp_path, num_envs, video_format):
    import imageio.v2 as imageio

    logger = VideoLogger("run", tmp_path, video_format=video_format, video_fps=5)
    env = TransformedEnv(
        make_env(num_envs=num_envs, from_pixels=True),
        Compose(
            PreferenceSampler(SPACE, seed=0),
            PreferenceOverlay(SPACE),
            VideoRecorder(logger, tag="drive"),
        ),
    )
    env.rollout(4, break_when_any_done=False)
    env.transform.dump()
    (path,) = (tmp_path / "run" / "videos").iterdir()
    assert path.name == f"drive_0.{video_format}"
    frames = imageio.mimread(path)
    side = 1 if num_envs == 1 else 2
    assert len(frames) == 5
    assert frames[0].shape[:2] == (108 * side, 192 * side)
    assert (frames[0] != frames[-1]).any()
    env.close()


@needs_gl
def test_video_recorder_with_the_logger_of_torchrl(tmp_path):
    logger = CSVLogger("run", str(tmp_path), video_format="pt")
    env = TransformedEnv(make_env(num_envs=2, from_pixels=True), VideoRecorder(logger, tag="drive"))
    env.rollout(3)
    env.transform.dump()
    video = torch.load(tmp_path / "run" / "videos" / "drive_0.pt")
    assert video.shape == (1, 4, 3, 108, 2 * 192)
    env.close()


def test_pictures_may_be_numpy_arrays(tmp_path):
    frames = torch.randint(0, 255, (3, 120, 200, 3), dtype=torch.uint8)
    bars = draw_preference(frames, torch.tensor([0.25, 0.75]), SPACE.tunable)
    upside_down = frames.flip(1).numpy()[:, ::-1]
    assert torch.equal(draw_preference(upside_down, [0.25, 0.75], SPACE.tunable), bars)
    paths = [
        write_video(tmp_path / name, pictures)
        for name, pictures in (("a.gif", frames), ("b.gif", upside_down))
    ]
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_write_video_checks_its_input(tmp_path):
    frames = torch.zeros(2, 33, 49, 3, dtype=torch.uint8)
    assert write_video(tmp_path / "new" / "odd.mp4", frames).stat().st_size > 0
    with pytest.raises(ValueError, match="suffix"):
        write_video(tmp_path / "a.avi", frames)
    with pytest.raises(ValueError, match="uint8"):
        write_video(tmp_path / "a.mp4", frames.float())
