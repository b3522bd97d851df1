"""Films of several preferences: the camera stays, and one colour is one objective."""

from __future__ import annotations

import pytest
import torch
from PIL import Image
from tensordict.nn import TensorDictModule

from envs import Camera, NavigationEnv
from envs.demonstrations import CircleDemonstrator
from envs.views import scene_view
from recipes.demo.film import _dashes, film
from recipes.demo.legend import legend_strip
from recipes.objectives import preference_colors
from tests._sweeps import BEND, DEMO_SPACE, SPACE, needs_gl
from torchrl_morl import PreferenceSpace
from torchrl_morl.evaluation import preference_strip

WIDTH, HEIGHT = 320, 180
LABELS = ("demonstration", "distance", "efficiency")


@pytest.fixture
def cameras(monkeypatch) -> list[Camera]:
    """What the simulation is asked to look through."""
    used = []
    render = NavigationEnv.render

    def spy(self, **kwargs):
        used.append(kwargs["camera"])
        return render(self, **kwargs)

    monkeypatch.setattr(NavigationEnv, "render", spy)
    return used


def frames_of(path) -> tuple[list[torch.Tensor], list[int]]:
    picture, frames, durations = Image.open(path), [], []
    for index in range(picture.n_frames):
        picture.seek(index)
        rgb = picture.convert("RGB")
        pixels = torch.frombuffer(bytearray(rgb.tobytes()), dtype=torch.uint8)
        frames.append(pixels.view(rgb.height, rgb.width, 3).int())
        durations.append(picture.info["duration"])
    return frames, durations


def test_view_contains_everything():
    """By hand: 2 to 12 m across with a box of 1 m around (1, 0), and 0.6 m of margin."""
    points = torch.tensor([[2.0, 0.0], [12.0, 3.0]])
    boxes = torch.tensor([[1.0, 0.0, 0.3, 0.6, 0.8], [50.0, 50.0, 0.0, 30.0, 1.0]])
    view = scene_view(points, boxes, aspect=1.0)
    assert view.lookat == pytest.approx((6.0, 1.0, 0.0))
    assert view.height == pytest.approx(12.0 + 1.2)
    assert scene_view(points, boxes, aspect=4.0).height == pytest.approx(4.0 + 1.2)


@needs_gl
def test_the_camera_stays_though_robots_leave_the_scene(cameras, tmp_path):
    """One preference drives straight on, the other one in a bend that leaves it far to the left."""

    def leave(preference):
        turn = 0.1 * preference[..., 0]
        return torch.stack((torch.ones_like(turn), turn), dim=-1)

    actor = TensorDictModule(leave, in_keys=["preference"], out_keys=["action"])
    where = {"scene": "empty", "seed": 3, "max_episode_steps": 60, "num_threads": 1}
    film(tmp_path / "film.gif", actor, SPACE, SPACE.corners(), size=(WIDTH, HEIGHT), **where)
    assert len(set(cameras)) == 1
    env = NavigationEnv(num_envs=1, **where)
    env.reset()
    assert cameras[0].height > 1.2 * env._camera("top", 0, WIDTH / HEIGHT).height
    env.close()


@needs_gl
def test_people_who_are_not_there_are_not_looked_for(cameras, tmp_path):
    """The scene has room for several people and boxes; who is missing stands a kilometre away."""
    where = {"scene": "everyday", "seed": 0, "max_episode_steps": 2, "num_threads": 1}
    film(tmp_path / "film.gif", BEND, SPACE, SPACE.corners()[:1], size=(WIDTH, HEIGHT), **where)
    assert 2.0 < cameras[0].height < 40.0


@needs_gl
def test_ends_stay_and_every_path_has_the_color_of_its_bar(tmp_path):
    preferences = torch.cat((DEMO_SPACE.corners(), torch.tensor([[0.0, 0.5, 0.5]])))
    steps = 20

    def fan(preference):
        turn = preference @ torch.tensor([0.06, 0.02, -0.06])
        return torch.stack((torch.ones_like(turn), turn), dim=-1)

    path = film(
        tmp_path / "film.gif",
        TensorDictModule(fan, in_keys=["preference"], out_keys=["action"]),
        DEMO_SPACE,
        preferences,
        scene="empty",
        seed=3,
        max_episode_steps=steps,
        size=(2 * WIDTH, 2 * HEIGHT),
        hold=1.0,
        num_threads=1,
    )
    frames, durations = frames_of(path)
    ends = [index for index, duration in enumerate(durations) if duration > 900]
    # The start, every third step, and the last one.
    assert ends == [7, 15, 23, 31] and len(frames) == 32
    assert set(durations) == {80, 1080}  # a second longer, in the hundredths that a GIF knows
    top = preference_strip(preferences[0], LABELS, width=2 * WIDTH).shape[0]
    colors = torch.from_numpy(preference_colors(preferences, DEMO_SPACE.tunable)) * 255
    for number, end in enumerate(ends):
        scene = frames[end][top : top + 2 * HEIGHT]
        for other, color in enumerate(colors):
            near = ((scene - color).abs().amax(-1) < 25).sum()
            # A path of 2 m, 0.08 m wide, where the picture shows about 8 m in 360 rows.
            assert (near > 50) == (other <= number), (number, other, int(near))


@needs_gl
def test_the_bars_hide_nothing(tmp_path):
    """They and the legend have rows of their own, above and below the picture."""
    path = film(
        tmp_path / "film.gif",
        BEND,
        DEMO_SPACE,
        DEMO_SPACE.corners()[:1],
        demonstrator=CircleDemonstrator(),
        max_episode_steps=3,
        size=(2 * WIDTH, 2 * HEIGHT),
    )
    (first, *_), _ = frames_of(path)
    bars = preference_colors(torch.eye(3), DEMO_SPACE.tunable)
    strip = preference_strip([1.0, 0.0, 0.0], LABELS, width=2 * WIDTH, colors=bars)
    legend = legend_strip(2 * WIDTH, demonstration=True)
    top, bottom = strip.shape[0], legend.shape[0]
    assert first.shape == (top + 2 * HEIGHT + bottom, 2 * WIDTH, 3)
    assert (first[:top] - strip).abs().float().mean() < 4.0
    assert (first[-bottom:] - legend).abs().float().mean() < 4.0


@needs_gl
@pytest.mark.parametrize(("scene", "dashed"), [("showcase", True), ("moving_human", False)])
def test_what_was_demonstrated_is_drawn_where_the_human_stands(
    scene, dashed, monkeypatch, tmp_path
):
    shown = []
    render = NavigationEnv.render

    def spy(self, **kwargs):
        shown.append(len(kwargs["trails"]))
        return render(self, **kwargs)

    monkeypatch.setattr(NavigationEnv, "render", spy)
    film(
        tmp_path / "film.gif",
        BEND,
        SPACE,
        SPACE.corners()[:1],
        scene=scene,
        seed=1,
        demonstrator=CircleDemonstrator(),
        max_episode_steps=60,
        every=60,
        size=(WIDTH, HEIGHT),
    )
    # The goal's star and the path; each dash is one more.
    assert (shown[0] > 2) == dashed


def test_dashes_cover_their_share_of_a_path():
    path = torch.tensor([[0.0, 0.0], [3.0, 0.0], [3.0, 0.0], [3.0, 0.8]], dtype=torch.float64)
    dashes = _dashes(path)
    assert len(dashes) == 10  # 3.8 m in pieces of 0.38 m
    length = sum((dash[1:] - dash[:-1]).norm(dim=-1).sum().item() for dash in dashes)
    assert length == pytest.approx(10 * 0.22)
    on_it = torch.cat(dashes)
    assert (((on_it[:, 1] == 0) & (on_it[:, 0] <= 3)) | (on_it[:, 0] == 3)).all()
    assert _dashes(path[:1]) == []


def test_an_objective_without_a_color_is_refused_before_anything_is_written(tmp_path):
    preference_space = PreferenceSpace(("core", "comfort", "distance"), static={"core": 1.0})
    with pytest.raises(ValueError, match="'comfort' has no row"):
        film(tmp_path / "film.gif", BEND, preference_space, preference_space.corners())
    assert not list(tmp_path.iterdir())


def test_legend_takes_more_lines_where_it_is_narrow():
    wide, narrow = (legend_strip(width, demonstration=True) for width in (640, 240))
    assert narrow.shape[0] > 1.1 * wide.shape[0]  # in smaller letters
    for strip in (wide, narrow):
        border = torch.cat((strip[0], strip[-1], strip[:, 0], strip[:, -1]))
        assert border.min() > 250
