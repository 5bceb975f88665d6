"""Pictures of episodes: frames, GIFs and film strips, drawn with Pillow.

A `Trace` is what happened: body states, actions, and which chunk acted when. Below each picture
lies a bar with one cell per control step; its shade changes where another chunk takes over, a dark
band marks the steps during which the next chunk is being computed (the delay), and a line marks
the step that is shown.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from rtc_cli.files import write_bytes
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import (
    Body,
    Box,
    Circle,
    FloatArray,
    Motor,
    Pivot,
    Polygon,
    Role,
    Scene,
    Segment,
    Shape,
    StateArray,
    Status,
    Thruster,
    Vec,
)

Color = tuple[int, int, int]
Feedback = Callable[[FloatArray, int], npt.ArrayLike]

# Okabe and Ito's palette: told apart by colour-blind readers too.
ROLE_COLORS: dict[Role, Color] = {
    Role.NONE: (150, 156, 166),
    Role.GOAL: (0, 114, 178),
    Role.TARGET: (0, 158, 115),
    Role.HAZARD: (213, 94, 0),
}
ROLE_NAMES: dict[Role, str] = {
    Role.GOAL: "goal object",
    Role.TARGET: "target: touch it",
    Role.HAZARD: "hazard: do not touch",
}
STATUS_NAMES: dict[Status, str] = {
    Status.RUNNING: "running",
    Status.SOLVED: "solved",
    Status.FAILED: "failed",
    Status.TIMEOUT: "out of time",
    Status.INVALID: "invalid",
}
BACKGROUND: Color = (250, 250, 248)
INK: Color = (45, 48, 54)
FAINT: Color = (222, 224, 228)
FLAME: Color = (240, 180, 20)
CHUNK_COLORS: tuple[Color, Color] = ((172, 196, 226), (112, 146, 190))
HOLD_COLOR: Color = (226, 226, 226)
DELAY_COLOR: Color = (45, 48, 54)
CURSOR: Color = (200, 30, 90)

SUPERSAMPLE = 2  # drawn larger and scaled down: smooth edges
FLAME_M = 0.35  # length of a flame at full thrust
MARGIN_M = 0.3


@dataclass(frozen=True)
class Trace:
    """An episode of T control steps.

    states (T + 1, bodies, 6), as `WorldBatch.states`; actions (T, A) physical, before noise;
    chunk (T,) number of the chunk that acts, −1 while holding still, all 0 without chunks;
    inferences: (start, ready) control steps of every inference; caption: who acts.
    """

    states: StateArray
    actions: FloatArray
    status: Status
    chunk: npt.NDArray[np.int64]
    inferences: tuple[tuple[int, int], ...] = ()
    caption: str = ""

    @property
    def ticks(self) -> int:
        """T, the number of control steps."""
        return len(self.actions)


def record_episode(scene: Scene, seed: int, act: Feedback, caption: str = "") -> Trace:
    """Run one episode of a feedback law: `act(observation (O,), tick)` gives one action (A,)."""
    states: list[StateArray] = []
    actions: list[FloatArray] = []
    with WorldBatch(scene, 1) as worlds:
        obs = worlds.reset([seed])[0]
        states.append(worlds.states[0])
        status = Status.RUNNING
        while status == Status.RUNNING:
            action = np.asarray(act(obs, len(actions)), np.float32).reshape(scene.action_dim)
            record = worlds.step(action[None, None])
            obs, status = record.obs[0], Status(int(record.status[0]))
            states.append(worlds.states[0])
            actions.append(action)
    chunk = np.zeros(len(actions), np.int64)
    return Trace(np.stack(states), np.stack(actions), status, chunk, (), caption)


def draw_frame(scene: Scene, trace: Trace, tick: int, width: int = 640) -> Image.Image:
    """The world after `tick` control steps, the actions that led there, and the chunk bar."""
    action = trace.actions[tick - 1] if tick > 0 else None
    picture = draw_world(scene, trace.states[tick], action, width)
    strip = _bar(trace, tick, width)
    frame = Image.new("RGB", (width, picture.height + strip.height), BACKGROUND)
    frame.paste(picture, (0, 0))
    frame.paste(strip, (0, picture.height))
    return frame


def save_gif(scene: Scene, trace: Trace, path: Path, width: int = 560) -> None:
    """Write the episode as an animation in real time, the last picture held for a second."""
    # GIF times are multiples of 10 ms and viewers slow down below 20 ms: every second step.
    stride = 2
    ticks = [*range(0, trace.ticks, stride), trace.ticks]
    frames = [_quantised(draw_frame(scene, trace, tick, width)) for tick in ticks]
    step_ms = round(1000 * stride / scene.control_hz / 10) * 10
    out = io.BytesIO()
    frames[0].save(
        out,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=[step_ms] * (len(frames) - 1) + [1000],
        loop=0,
        optimize=True,
    )
    write_bytes(path, out.getvalue())


def save_film_strip(
    scene: Scene, trace: Trace, path: Path, frames: int = 8, columns: int = 4, width: int = 400
) -> None:
    """Write one PNG with `frames` pictures, evenly spread over the episode, and a legend."""
    ticks = np.unique(np.linspace(0, trace.ticks, frames).round().astype(int)).tolist()
    pictures = [draw_frame(scene, trace, tick, width) for tick in ticks]
    columns = min(columns, len(pictures))
    rows = math.ceil(len(pictures) / columns)
    gap, height = 8, pictures[0].height
    head = _heading(scene, trace, columns * (width + gap) + gap)
    sheet = Image.new(
        "RGB", (head.width, head.height + rows * (height + gap) + gap), (255, 255, 255)
    )
    sheet.paste(head, (0, 0))
    for i, picture in enumerate(pictures):
        column, row = i % columns, i // columns
        sheet.paste(picture, (gap + column * (width + gap), head.height + row * (height + gap)))
    out = io.BytesIO()
    sheet.save(out, format="PNG", optimize=True)
    write_bytes(path, out.getvalue())


def draw_world(
    scene: Scene, state: StateArray, action: FloatArray | None = None, width: int = 640
) -> Image.Image:
    """The bodies at `state` (bodies, 6), with flames and turning joints where `action` acts."""
    camera = _Camera(scene, width)
    image = Image.new("RGB", camera.size, BACKGROUND)
    draw = ImageDraw.Draw(image)
    if action is not None:
        for thruster in scene.thrusters:
            _draw_flame(draw, camera, scene, state, thruster, action)
    for i, body in enumerate(scene.bodies):
        for shape in body.shapes:
            _draw_shape(draw, camera, shape, body, state[i])
    for joint in scene.joints:
        if isinstance(joint, Pivot):
            _draw_pivot(draw, camera, scene, state, joint)
    if action is not None:
        for motor in scene.motors:
            _draw_motor(draw, camera, scene, state, motor, action)
    return image.resize((width, image.height // SUPERSAMPLE), Image.Resampling.LANCZOS)


class _Camera:
    """World metres -> pixels of the supersampled picture."""

    def __init__(self, scene: Scene, width: int) -> None:
        x0, y0, x1, y1 = scene.view or _extent(scene)
        self.left, self.top = x0, y1
        self.scale = SUPERSAMPLE * width / (x1 - x0)
        self.size = (SUPERSAMPLE * width, SUPERSAMPLE * round((y1 - y0) * self.scale / SUPERSAMPLE))

    def __call__(self, point: Vec) -> Vec:
        return ((point[0] - self.left) * self.scale, (self.top - point[1]) * self.scale)


def _extent(scene: Scene) -> tuple[float, float, float, float]:
    """A rectangle round everything at its declared place."""
    points: list[Vec] = []
    for body in scene.bodies:
        pose = np.array([*body.position, 0.0, 0.0, body.angle, 0.0])
        for shape in body.shapes:
            outline, radius = _outline(shape)
            for x, y in (_placed(point, pose) for point in outline):
                points += [(x - radius, y - radius), (x + radius, y + radius)]
    xs, ys = [p[0] for p in points], [p[1] for p in points]
    return min(xs) - MARGIN_M, min(ys) - MARGIN_M, max(xs) + MARGIN_M, max(ys) + MARGIN_M


def _placed(point: Vec, pose: StateArray) -> Vec:
    c, s = math.cos(pose[4]), math.sin(pose[4])
    return (pose[0] + c * point[0] - s * point[1], pose[1] + s * point[0] + c * point[1])


def _outline(shape: Shape) -> tuple[Sequence[Vec], float]:
    """Points of a shape in its body's frame, and the radius around them."""
    if isinstance(shape, Box | Polygon):
        return shape.vertices, 0.0
    if isinstance(shape, Circle):
        return (shape.offset,), shape.radius
    if isinstance(shape, Segment):
        return (shape.start, shape.end), shape.radius
    raise TypeError(f"shapes of type {type(shape).__name__} cannot be drawn")


def _draw_shape(
    draw: ImageDraw.ImageDraw, camera: _Camera, shape: Shape, body: Body, pose: StateArray
) -> None:
    color = ROLE_COLORS[shape.role]
    edge = _darker(color)
    outline, radius = _outline(shape)
    points = [camera(_placed(point, pose)) for point in outline]
    r = radius * camera.scale
    if isinstance(shape, Circle):
        (x, y) = points[0]
        draw.ellipse((x - r, y - r, x + r, y + r), fill=color, outline=edge, width=SUPERSAMPLE)
        rim = camera(_placed((shape.offset[0] + radius, shape.offset[1]), pose))
        draw.line((x, y, *rim), fill=edge, width=SUPERSAMPLE)  # shows that it turns
    elif isinstance(shape, Segment):
        draw.line((*points[0], *points[1]), fill=color, width=max(1, round(2 * r)))
        for x, y in points:
            draw.ellipse((x - r, y - r, x + r, y + r), fill=color)
    else:
        draw.polygon(points, fill=color, outline=edge, width=SUPERSAMPLE)


def _darker(color: Color) -> Color:
    return (int(0.72 * color[0]), int(0.72 * color[1]), int(0.72 * color[2]))


def _draw_flame(
    draw: ImageDraw.ImageDraw,
    camera: _Camera,
    scene: Scene,
    state: StateArray,
    thruster: Thruster,
    action: FloatArray,
) -> None:
    """A flame opposite to the thruster's force, as long as it is strong."""
    level = float(action[_action_index(scene, thruster.action)])
    pose = state[scene.body_index[thruster.body]]
    (px, py), (dx, dy) = thruster.point, thruster.direction
    norm = math.hypot(dx, dy)
    dx, dy = dx / norm, dy / norm
    length, half = FLAME_M * abs(level), 0.07
    sign = math.copysign(1.0, level)
    tip = (px - sign * dx * length, py - sign * dy * length)
    base = [(px - dy * half, py + dx * half), (px + dy * half, py - dx * half)]
    if abs(level) > 0.03:
        draw.polygon([camera(_placed(p, pose)) for p in (*base, tip)], fill=FLAME)


def _draw_pivot(
    draw: ImageDraw.ImageDraw, camera: _Camera, scene: Scene, state: StateArray, joint: Pivot
) -> None:
    x, y = camera(_anchor(scene, state, joint))
    r = 0.035 * camera.scale
    draw.ellipse((x - r, y - r, x + r, y + r), fill=BACKGROUND, outline=INK, width=SUPERSAMPLE)


def _draw_motor(
    draw: ImageDraw.ImageDraw,
    camera: _Camera,
    scene: Scene,
    state: StateArray,
    motor: Motor,
    action: FloatArray,
) -> None:
    """An arc at the motor's joint: its length is the command, its side the sense of turning."""
    level = float(action[_action_index(scene, motor.action)])
    pair = {motor.a, motor.b}
    joint = next((j for j in scene.joints if isinstance(j, Pivot) and {j.a, j.b} == pair), None)
    if joint is None or abs(level) < 0.03:
        return
    x, y = camera(_anchor(scene, state, joint))
    r = 0.11 * camera.scale
    sweep = 170 * min(abs(level), 1.0)
    start, end = (90 - sweep, 90) if level > 0 else (90, 90 + sweep)
    draw.arc((x - r, y - r, x + r, y + r), start, end, fill=FLAME, width=3 * SUPERSAMPLE)


def _anchor(scene: Scene, state: StateArray, joint: Pivot) -> Vec:
    """Where a pivot is now: its anchor is declared in the declared pose of a body."""
    name = joint.b if joint.b in scene.body_index else joint.a
    index = scene.body_index[name]
    body = scene.bodies[index]
    dx, dy = joint.anchor[0] - body.position[0], joint.anchor[1] - body.position[1]
    c, s = math.cos(-body.angle), math.sin(-body.angle)
    return _placed((c * dx - s * dy, s * dx + c * dy), state[index])


def _action_index(scene: Scene, name: str) -> int:
    return [action.name for action in scene.actions].index(name)


def _bar(trace: Trace, tick: int, width: int) -> Image.Image:
    """One cell per control step: who acts, when the next chunk is computed, where we are."""
    height, pad, top, thick = 44, 8, 4, 12
    image = Image.new("RGB", (width, height), BACKGROUND)
    draw = ImageDraw.Draw(image)

    def at(step: float) -> float:
        return pad + (width - 2 * pad) * step / trace.ticks

    for step, chunk in enumerate(trace.chunk.tolist()):
        color = HOLD_COLOR if chunk < 0 else CHUNK_COLORS[chunk % 2]
        draw.rectangle((at(step), top, at(step + 1) - 1, top + thick), fill=color)
    for start, ready in trace.inferences:
        if start < trace.ticks and ready > start:
            end = at(min(ready, trace.ticks)) - 1
            draw.rectangle((at(start) + 1, top + thick - 3, end, top + thick), fill=DELAY_COLOR)
    here = min(at(tick), width - pad)
    draw.line((here, 0, here, top + thick + 4), fill=CURSOR, width=2)
    text = f"step {tick}"
    if tick == trace.ticks:
        text += f": {STATUS_NAMES[trace.status]}"
    draw.text((pad, top + thick + 6), text, fill=INK, font=_font(13))
    room = width - 3 * pad - draw.textlength(text, font=_font(13))
    length = draw.textlength(trace.caption, font=_font(13))
    if length < room:
        draw.text((width - pad - length, top + thick + 6), trace.caption, INK, _font(13))
    return image


def _heading(scene: Scene, trace: Trace, width: int) -> Image.Image:
    """Title, the legend of the colours, and the legend of the bar."""
    image = Image.new("RGB", (width, 84), (255, 255, 255))
    draw = ImageDraw.Draw(image)
    title = f"{scene.name}: {trace.caption}" if trace.caption else scene.name
    draw.text((12, 8), title, fill=INK, font=_font(17))
    x = 12.0
    for role, name in ROLE_NAMES.items():
        x = _entry(draw, x, 36, ROLE_COLORS[role], name)
    _entry(draw, x, 36, FLAME, "thruster or motor at work")
    if trace.chunk.any():
        x = _entry(draw, 12, 60, CHUNK_COLORS[0], "one chunk of actions,")
        x = _entry(draw, x - 8, 60, CHUNK_COLORS[1], "the next")
    else:
        x = _entry(draw, 12, 60, CHUNK_COLORS[0], "every action from the latest observation")
    if any(ready > start for start, ready in trace.inferences):
        x = _entry(draw, x, 60, DELAY_COLOR, "next chunk is being computed (delay)")
    _entry(draw, x, 60, CURSOR, "step shown")
    return image


def _entry(draw: ImageDraw.ImageDraw, x: float, y: int, color: Color, text: str) -> float:
    """Draw one legend entry and return where the next one starts."""
    draw.rectangle((x, y + 2, x + 13, y + 15), fill=color)
    draw.text((x + 19, y), text, fill=INK, font=_font(14))
    return x + 19 + draw.textlength(text, font=_font(14)) + 22


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _quantised(frame: Image.Image) -> Image.Image:
    return frame.quantize(palette=_palette(), dither=Image.Dither.NONE)


@cache
def _palette() -> Image.Image:
    """Our own colours and their blends with the background: small parts keep their colour too."""
    bodies = [*ROLE_COLORS.values()]
    edges = [_darker(color) for color in bodies]
    rest = [*CHUNK_COLORS, HOLD_COLOR, DELAY_COLOR, FLAME, CURSOR]
    colors = [BACKGROUND]
    for color in (*bodies, *edges, *rest):
        for share in np.linspace(0.25, 1.0, 6):
            blend = share * np.array(color) + (1.0 - share) * np.array(BACKGROUND)
            colors.append((int(blend[0]), int(blend[1]), int(blend[2])))
    image = Image.new("P", (1, 1))
    image.putpalette([part for color in colors for part in color])
    return image
