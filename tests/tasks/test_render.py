"""Pictures: what they show, and that they can be read back."""

import numpy as np
import pytest
from PIL import Image

from rtc_cli.tasks import get_task, list_tasks
from rtc_cli.tasks.library import get_controller
from rtc_cli.tasks.render import (
    BACKGROUND,
    DELAY_COLOR,
    FLAME,
    HOLD_COLOR,
    ROLE_COLORS,
    Trace,
    draw_frame,
    draw_world,
    record_episode,
    save_film_strip,
    save_gif,
)
from rtc_cli.tasks.scene import Role, Status


def pixels(image: Image.Image, color: tuple[int, int, int]) -> int:
    """Pixels of about this colour: edges are blends."""
    difference = np.abs(np.asarray(image.convert("RGB"), int) - np.array(color))
    return int((difference.max(axis=-1) < 45).sum())


@pytest.fixture(scope="module")
def catcher():
    return get_task("catcher")


@pytest.fixture(scope="module")
def trace(catcher):
    controller = get_controller("catcher")
    return record_episode(catcher, 0, lambda obs, tick: controller(obs[None]), "by hand")


def chunked(trace: Trace, first: int) -> Trace:
    chunk = np.maximum(0, (np.arange(trace.ticks) + 2) // 4) + first
    windows = tuple((start, start + 2) for start in range(0, trace.ticks, 4))
    return Trace(trace.states, trace.actions, trace.status, chunk, windows)


def test_an_episode_is_recorded_whole(catcher, trace):
    assert trace.status == Status.SOLVED
    assert trace.states.shape == (trace.ticks + 1, len(catcher.bodies), 6)
    assert trace.actions.shape == (trace.ticks, catcher.action_dim)
    assert len(trace.chunk) == trace.ticks


@pytest.mark.parametrize("name", list_tasks())
def test_every_role_is_visible(name):
    scene = get_task(name)
    trace = record_episode(scene, 0, lambda obs, tick: scene.action_low)
    picture = draw_world(scene, trace.states[0], width=400)
    roles = {shape.role for body in scene.bodies for shape in body.shapes} - {Role.NONE}
    for role in roles:
        assert pixels(picture, ROLE_COLORS[role]) > 8


def test_thrusters_show_only_when_they_act(catcher, trace):
    idle = draw_world(catcher, trace.states[0], np.zeros(2, np.float32))
    acting = draw_world(catcher, trace.states[0], np.array([1.0, 0.0], np.float32))
    assert pixels(idle, FLAME) == 0
    assert pixels(acting, FLAME) > 8


def test_motors_show_only_when_they_act():
    scene = get_task("lunar_lander")
    trace = record_episode(scene, 0, lambda obs, tick: np.zeros(4))
    idle = draw_world(scene, trace.states[0], np.zeros(4, np.float32))
    acting = draw_world(scene, trace.states[0], np.array([0, 0, 1, 0], np.float32))
    assert pixels(idle, FLAME) == 0
    assert pixels(acting, FLAME) > 10


def test_the_delay_and_holding_still_are_marked(catcher, trace):
    marked = chunked(trace, first=0)
    bar = 44
    plain = draw_frame(catcher, trace, 10)
    shown = draw_frame(catcher, marked, 10)
    held = Trace(trace.states, trace.actions, trace.status, np.full(trace.ticks, -1), ())
    strip = (0, plain.height - bar, plain.width, plain.height)
    assert pixels(shown.crop(strip), DELAY_COLOR) > pixels(plain.crop(strip), DELAY_COLOR) + 100
    assert pixels(draw_frame(catcher, held, 10).crop(strip), HOLD_COLOR) > 100


def test_a_gif_plays_in_real_time(catcher, trace, tmp_path):
    path = tmp_path / "episode.gif"
    save_gif(catcher, trace, path, width=240)
    with Image.open(path) as gif:
        durations = []
        for frame in range(gif.n_frames):
            gif.seek(frame)
            durations.append(gif.info["duration"])
        assert pixels(gif, ROLE_COLORS[Role.TARGET]) > 8  # small parts keep their colour
    episode_ms = 1000 * trace.ticks / catcher.control_hz
    assert sum(durations) - 1000 == pytest.approx(episode_ms, rel=0.1)


def test_a_film_strip_holds_the_pictures_asked_for(catcher, trace, tmp_path):
    few, many = tmp_path / "few.png", tmp_path / "many.png"
    save_film_strip(catcher, trace, few, frames=2, columns=2, width=120)
    save_film_strip(catcher, chunked(trace, 1), many, frames=6, columns=2, width=120)
    with Image.open(few) as a, Image.open(many) as b:
        assert a.width == b.width
        row = draw_frame(catcher, trace, 0, width=120).height
        assert b.height - a.height == pytest.approx(2 * row, abs=20)
        assert pixels(a, BACKGROUND) > 0
