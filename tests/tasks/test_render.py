"""Pictures: what they show, and that they can be read back."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from toy_scenes import machine

from rtc_cli.tasks import get_task, list_tasks
from rtc_cli.tasks.drawing import BACKGROUND, FLAME, MOTOR, ROLE_COLORS, draw_world
from rtc_cli.tasks.library import get_controller
from rtc_cli.tasks.render import (
    draw_frame,
    draw_picture,
    save_film_strip,
    save_gif,
)
from rtc_cli.tasks.scene import Role, Status
from rtc_cli.tasks.strip import (
    CURSOR,
    HOLD_COLOR,
    STATUS_COLORS,
    chunk_color,
    darker,
    draw_strip,
)
from rtc_cli.tasks.trace import Trace, record_episode

STEP_S = 1 / 30


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


def chunked(trace: Trace, delay: int = 2) -> Trace:
    """The episode as if chunks of 4 steps had acted, each ready `delay` steps after its start."""
    chunk = np.maximum(0, (np.arange(trace.ticks) + 4 - delay) // 4)
    windows = tuple((start, start + delay) for start in range(0, trace.ticks, 4))
    return replace(trace, chunk=chunk, inferences=windows)


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


def test_thrusters_show_as_much_as_they_act(catcher, trace):
    flames = [
        pixels(draw_world(catcher, trace.states[0], np.array([level, 0], np.float32)), FLAME)
        for level in (0.0, 0.4, 1.0)
    ]
    assert flames[0] == 0
    assert 8 < flames[1] < flames[2]


def test_motors_show_only_when_they_act():
    scene = get_task("lunar_lander")
    state = scene.declared_states
    idle = draw_world(scene, state, np.zeros(4, np.float32))
    acting = [
        draw_world(scene, state, np.array([0, 0, level, 0], np.float32)) for level in (1.0, -1.0)
    ]
    assert pixels(idle, MOTOR) < 3
    assert all(pixels(picture, MOTOR) > 30 for picture in acting)
    assert (np.asarray(acting[0]) != np.asarray(acting[1])).any()  # the sense of turning


def test_springs_ropes_and_every_shape_can_be_drawn():
    scene = machine()
    picture = draw_world(scene, scene.declared_states, np.ones(4, np.float32), width=300)
    assert all(pixels(picture, ROLE_COLORS[role]) > 8 for role in Role)


def colors_in(strip: Image.Image, row: int) -> list[tuple[int, ...]]:
    """The colours of a row of pixels, without repetition, from left to right."""
    found = [tuple(pixel) for pixel in np.asarray(strip)[row].tolist()]
    return [b for a, b in zip([None, *found], found, strict=False) if a != b]


@pytest.mark.parametrize("tick", [0, 1, 30, 75])
def test_the_strip_shows_chunks_and_inferences_around_now(trace, tick):
    delay = 2
    marked = chunked(trace, delay)
    strip = draw_strip(marked, tick, 400, STEP_S)
    lane, inference = (colors_in(strip, row) for row in (20, 30))
    near = range(max(0, tick - 11), min(trace.ticks, tick + 11))
    for step in near:
        assert chunk_color(int(marked.chunk[step]), ahead=step >= tick) in lane
    for number, (start, ready) in enumerate(marked.inferences, 1):
        if start in near and ready <= tick:
            assert darker(chunk_color(number)) in inference
    assert CURSOR in lane
    assert CURSOR in inference


def test_an_inference_ends_where_its_chunk_takes_over(trace):
    """The inference's bar of chunk k ends in the column in which the cells of chunk k begin."""
    strip = np.asarray(draw_strip(chunked(trace), 30, 400, STEP_S))
    number = int(chunked(trace).chunk[29])
    cells = np.flatnonzero((strip[9] == chunk_color(number)).all(axis=-1))
    bar = np.flatnonzero((strip[30] == darker(chunk_color(number))).all(axis=-1))
    three_chunks_on = cells[cells > bar[-1]]  # colours come again
    assert three_chunks_on[0] - bar[-1] <= 2


def test_holding_still_has_its_own_colour(trace):
    held = replace(trace, chunk=np.full(trace.ticks, -1))
    assert HOLD_COLOR in colors_in(draw_strip(held, 10, 400, STEP_S), 20)


def test_without_chunks_there_is_no_lane(catcher, trace):
    plain = draw_frame(catcher, trace, 10)
    assert plain.height < draw_frame(catcher, chunked(trace), 10).height


def test_the_last_picture_tells_the_outcome(catcher, trace):
    color = STATUS_COLORS[trace.status]
    assert draw_picture(catcher, trace, trace.ticks).getpixel((0, 0)) == color
    assert draw_picture(catcher, trace, trace.ticks - 1).getpixel((0, 0)) != color
    failed = replace(trace, status=Status.FAILED)
    assert draw_picture(catcher, failed, trace.ticks).getpixel((0, 0)) == (180, 60, 0)
    assert (
        draw_frame(catcher, trace, 999).tobytes()
        == draw_frame(catcher, trace, trace.ticks).tobytes()
    )


def test_a_gif_plays_in_real_time(catcher, trace, tmp_path):
    path = tmp_path / "episode.gif"
    save_gif(catcher, [trace], path, width=240)
    with Image.open(path) as gif:
        durations = []
        for frame in range(gif.n_frames):
            gif.seek(frame)
            durations.append(gif.info["duration"])
        assert pixels(gif, ROLE_COLORS[Role.TARGET]) > 8  # small parts keep their colour
    episode_ms = 1000 * trace.ticks / catcher.control_hz
    assert sum(durations) - 1500 == pytest.approx(episode_ms, rel=0.1)


def test_a_film_strip_holds_the_pictures_asked_for(catcher, trace, tmp_path):
    few, many = tmp_path / "few.png", tmp_path / "many.png"
    save_film_strip(catcher, [trace], few, frames=2, columns=2, width=120)
    save_film_strip(catcher, [trace], many, frames=6, columns=2, width=120)
    with Image.open(few) as a, Image.open(many) as b:
        assert a.width == b.width
        row = draw_frame(catcher, trace, 0, width=120).height
        assert b.height - a.height == pytest.approx(2 * row, abs=20)
        assert pixels(a, BACKGROUND) > 0


def test_several_episodes_lie_beside_each_other_or_stacked(catcher, trace, tmp_path):
    """Wide worlds one below the other; an episode that has ended keeps its last picture."""
    lander = get_task("lunar_lander")
    flat = record_episode(lander, 0, lambda obs, tick: np.ones(4))
    short = replace(trace, states=trace.states[:21], actions=trace.actions[:20])
    sizes = {}
    for name, scene, traces in (
        ("one", catcher, [trace]),
        ("two", catcher, [trace, short]),
        ("flat", lander, [flat]),
        ("stacked", lander, [flat, flat]),
    ):
        path = tmp_path / f"{name}.gif"
        save_gif(scene, traces, path, width=120)
        with Image.open(path) as gif:
            sizes[name] = (*gif.size, gif.n_frames)
    assert sizes["two"] == (248, *sizes["one"][1:])
    assert sizes["stacked"][0] == 120
    assert sizes["stacked"][1] == 2 * sizes["flat"][1] + 8
