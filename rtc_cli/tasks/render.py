"""Pictures of episodes: frames, GIFs and film strips, of one episode or of several side by side.

Several traces are meant to be of the same episode seed under different methods. One that has ended
keeps its last picture.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from rtc_cli.files import write_bytes
from rtc_cli.tasks.drawing import (
    BACKGROUND,
    FAINT,
    FLAME,
    FLAME_CORE,
    INK,
    MOTOR,
    ROLE_COLORS,
    Color,
    darker,
    draw_world,
    mixed,
    picture_size,
)
from rtc_cli.tasks.scene import Role, Scene
from rtc_cli.tasks.strip import (
    CHUNK_COLORS,
    CURSOR,
    HOLD_COLOR,
    STATUS_COLORS,
    draw_outcome,
    draw_strip,
    font,
)
from rtc_cli.tasks.trace import Trace

ROLE_NAMES: dict[Role, str] = {
    Role.GOAL: "goal object",
    Role.TARGET: "target: touch it",
    Role.HAZARD: "hazard: do not touch",
}
WHITE: Color = (255, 255, 255)
GIF_WIDTHS = (560, 420, 340)  # pixels of one picture with one, two, or more side by side
GAP = 8  # pixels between pictures
FLAT = 2.0  # worlds wider than this times their height are stacked, not put side by side


def draw_picture(scene: Scene, trace: Trace, tick: int, width: int = 640) -> Image.Image:
    """The world after `tick` control steps, the actions that led there, and how it ended."""
    action = trace.actions[tick - 1] if tick > 0 else None
    picture = draw_world(scene, trace.states[tick], action, width)
    if tick == trace.ticks:
        draw_outcome(picture, trace.status)
    return picture


def draw_frame(scene: Scene, trace: Trace, tick: int, width: int = 640) -> Image.Image:
    """The picture after `tick` control steps (the last one if there are fewer) and its strip."""
    tick = min(tick, trace.ticks)
    picture = draw_picture(scene, trace, tick, width)
    strip = draw_strip(trace, tick, width, 1.0 / scene.control_hz)
    return _stacked([picture, strip], gap=0, color=BACKGROUND)


def save_gif(scene: Scene, traces: Sequence[Trace], path: Path, width: int | None = None) -> None:
    """Write episodes as one animation in real time, the last picture held for 1.5 seconds.

    `width` of one picture; by default 560 pixels, less the more episodes there are.
    """
    # GIF times are multiples of 10 ms and viewers slow down below 20 ms: every second step.
    stride = 2
    last = max(trace.ticks for trace in traces)
    width = width or GIF_WIDTHS[min(len(traces), len(GIF_WIDTHS)) - 1]
    ticks = [*range(0, last, stride), last]
    frames = [_quantised(_panels(scene, traces, tick, width)) for tick in ticks]
    step_ms = round(1000 * stride / scene.control_hz / 10) * 10
    out = io.BytesIO()
    frames[0].save(
        out,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=[step_ms] * (len(frames) - 1) + [1500],
        loop=0,
        optimize=True,
    )
    write_bytes(path, out.getvalue())


def save_film_strip(
    scene: Scene,
    traces: Sequence[Trace],
    path: Path,
    frames: int = 8,
    columns: int = 4,
    width: int = 400,
    heading: bool = True,
) -> None:
    """Write one PNG with `frames` pictures per episode, evenly spread in time, below a legend.

    The pictures of several episodes at the same steps lie one below the other.
    """
    last = max(trace.ticks for trace in traces)
    ticks = np.unique(np.linspace(0, last, frames).round().astype(int)).tolist()
    columns = min(columns, len(ticks))
    rows = [
        _beside([draw_frame(scene, trace, tick, width) for tick in ticks[at : at + columns]])
        for at in range(0, len(ticks), columns)
        for trace in traces
    ]
    sheet_width = columns * (width + GAP) + GAP
    head = [_heading(scene, traces, sheet_width - GAP)] if heading else []
    film = _stacked([*head, *rows])
    sheet = Image.new("RGB", (sheet_width, film.height + GAP), WHITE)
    sheet.paste(film, (GAP, 0))
    out = io.BytesIO()
    sheet.save(out, format="PNG", optimize=True)
    write_bytes(path, out.getvalue())


def _panels(scene: Scene, traces: Sequence[Trace], tick: int, width: int) -> Image.Image:
    """All episodes at one step."""
    frames = [draw_frame(scene, trace, tick, width) for trace in traces]
    return _stacked(frames) if is_flat(scene) else _beside(frames)


def is_flat(scene: Scene) -> bool:
    """Whether the pictures of a scene are so wide that several are better stacked."""
    width, height = picture_size(scene, 640)
    return width > FLAT * height


def _beside(images: Sequence[Image.Image]) -> Image.Image:
    width = sum(image.width for image in images) + GAP * (len(images) - 1)
    sheet = Image.new("RGB", (width, max(image.height for image in images)), WHITE)
    at = 0
    for image in images:
        sheet.paste(image, (at, 0))
        at += image.width + GAP
    return sheet


def _stacked(images: Sequence[Image.Image], gap: int = GAP, color: Color = WHITE) -> Image.Image:
    height = sum(image.height for image in images) + gap * (len(images) - 1)
    sheet = Image.new("RGB", (max(image.width for image in images), height), color)
    at = 0
    for image in images:
        sheet.paste(image, (0, at))
        at += image.height + gap
    return sheet


def _heading(scene: Scene, traces: Sequence[Trace], width: int) -> Image.Image:
    """Title, the legend of the colours, and the legend of the strip."""
    chunked = any(trace.chunked for trace in traces)
    image = Image.new("RGB", (width, 84 if chunked else 62), WHITE)
    draw = ImageDraw.Draw(image)
    captions = "  |  ".join(trace.caption for trace in traces)
    name = scene.name
    draw.text((4, 8), f"{name}: {captions}" if captions else name, INK, font(17))
    x = 4.0
    for role, name in ROLE_NAMES.items():
        x = _entry(draw, x, 36, (ROLE_COLORS[role],), name)
    if scene.thrusters:
        x = _entry(draw, x, 36, (FLAME,), "thruster at work")
    if scene.motors:
        _entry(draw, x, 36, (MOTOR,), "motor at work")
    if chunked:
        x = _entry(
            draw,
            4,
            60,
            CHUNK_COLORS,
            "the chunk that acts; below it, the time in which a chunk is computed",
        )
        x = _entry(draw, x, 60, (HOLD_COLOR,), "holding still")
        _entry(draw, x, 60, (CURSOR,), "now")
    return image


def _entry(
    draw: ImageDraw.ImageDraw, x: float, y: int, colors: Sequence[Color], text: str
) -> float:
    """Draw one legend entry and return where the next one starts."""
    for color in colors:
        draw.rectangle((x, y + 2, x + 13, y + 15), fill=color)
        x += 14
    draw.text((x + 5, y), text, fill=INK, font=font(14))
    return x + 5 + draw.textlength(text, font=font(14)) + 22


def _quantised(frame: Image.Image) -> Image.Image:
    return frame.quantize(palette=_palette(), dither=Image.Dither.NONE)


@cache
def _palette() -> Image.Image:
    """Our own colours and their blends with the background: small parts keep their colour too."""
    bodies = [*ROLE_COLORS.values()]
    inks = [*bodies, *map(darker, bodies), INK, FLAME, MOTOR, CURSOR, *STATUS_COLORS.values()]
    lanes = [*CHUNK_COLORS, HOLD_COLOR, FAINT, FLAME_CORE]
    colors = [BACKGROUND, WHITE, *map(darker, CHUNK_COLORS)]
    for some, shares in ((inks, np.linspace(0.2, 1.0, 6)), (lanes, np.linspace(0.4, 1.0, 4))):
        colors += [mixed(color, BACKGROUND, float(share)) for color in some for share in shares]
    colors += [mixed(INK, color, share) for color in CHUNK_COLORS for share in (0.35, 0.7)]
    image = Image.new("P", (1, 1))
    image.putpalette([part for color in dict.fromkeys(colors) for part in color])
    return image
