"""Draws one moment of a world with Pillow: bodies in the colours of their roles, what acts on them.

Flames and arrows are as long as the action asks for; noise is not shown. Everything is drawn larger
and scaled down, so that edges are smooth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from rtc_cli.tasks.scene import (
    Body,
    Box,
    Circle,
    FloatArray,
    Groove,
    Joint,
    Pivot,
    Polygon,
    Role,
    Rope,
    Scene,
    Segment,
    Shape,
    Spring,
    StateArray,
    Thruster,
    Vec,
)

Color = tuple[int, int, int]

# Okabe and Ito's palette: told apart by colour-blind readers too.
ROLE_COLORS: dict[Role, Color] = {
    Role.NONE: (150, 156, 166),
    Role.GOAL: (0, 114, 178),
    Role.TARGET: (0, 158, 115),
    Role.HAZARD: (213, 94, 0),
}
BACKGROUND: Color = (250, 250, 248)
INK: Color = (45, 48, 54)
FAINT: Color = (222, 224, 228)
FLAME: Color = (240, 170, 10)
FLAME_CORE: Color = (255, 226, 110)
MOTOR: Color = (204, 121, 167)

SUPERSAMPLE = 3
MARGIN_M = 0.3
# Sizes of what is not part of the world, as shares of the picture's width.
FLAME_LENGTH = 0.065  # at full thrust
ARROW_RADIUS = (0.016, 0.03)  # least and most; in between it follows the size of what turns
PIN_RADIUS = 0.0045
LINE = 0.002
LEAST_ACTION = 0.03  # share of the largest; less than this is not drawn


def draw_world(
    scene: Scene, state: StateArray, action: FloatArray | None = None, width: int = 640
) -> Image.Image:
    """The bodies at `state` (bodies, 6); flames and arrows where `action` (A,) acts."""
    camera = _Camera(scene, width)
    image = Image.new("RGB", camera.size, BACKGROUND)
    draw = ImageDraw.Draw(image)
    bodies = sorted(zip(scene.bodies, state, strict=True), key=lambda pair: not pair[0].static)
    for joint in scene.joints:
        _draw_connection(draw, camera, scene, state, joint)
    for body, pose in bodies:
        for shape in body.shapes:
            _draw_shape(draw, camera, shape, pose)
    for joint in scene.joints:
        if isinstance(joint, Pivot):
            _draw_pin(draw, camera, _anchor(scene, state, joint.b, joint.a, joint.anchor))
    if action is not None:
        _draw_actions(draw, camera, scene, state, action)
    return image.reduce(SUPERSAMPLE)


def picture_size(scene: Scene, width: int) -> tuple[int, int]:
    """Width and height in pixels of a picture that is `width` wide."""
    return width, _Camera(scene, width).size[1] // SUPERSAMPLE


def darker(color: Color) -> Color:
    """The colour of an edge."""
    return mixed(color, (0, 0, 0), 0.72)


def mixed(color: Color, other: Color, share: float) -> Color:
    """`share` of `color`, the rest of `other`."""
    blend = share * np.array(color) + (1.0 - share) * np.array(other)
    return (int(blend[0]), int(blend[1]), int(blend[2]))


class _Camera:
    """World metres -> pixels of the supersampled picture."""

    def __init__(self, scene: Scene, width: int) -> None:
        x0, y0, x1, y1 = scene.view or _extent(scene)
        self.left, self.top = x0, y1
        self.metres = x1 - x0
        self.width = SUPERSAMPLE * width
        self.scale = self.width / self.metres
        self.size = (self.width, SUPERSAMPLE * round((y1 - y0) * self.scale / SUPERSAMPLE))

    def __call__(self, point: Vec) -> Vec:
        return ((point[0] - self.left) * self.scale, (self.top - point[1]) * self.scale)

    @property
    def line(self) -> int:
        """Pixels of a thin line."""
        return max(SUPERSAMPLE, round(LINE * self.width))


def _extent(scene: Scene) -> tuple[float, float, float, float]:
    """A rectangle round everything at its declared place."""
    points: list[Vec] = []
    for body, pose in zip(scene.bodies, scene.declared_states, strict=True):
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


def _draw_shape(draw: ImageDraw.ImageDraw, camera: _Camera, shape: Shape, pose: StateArray) -> None:
    """A filled outline; sensors, which hold nothing back, are paler."""
    color = ROLE_COLORS[shape.role]
    edge = darker(color)
    if shape.sensor:
        color = mixed(color, BACKGROUND, 0.35)
    outline, radius = _outline(shape)
    points = [camera(_placed(point, pose)) for point in outline]
    r = radius * camera.scale
    if isinstance(shape, Circle):
        (x, y) = points[0]
        draw.ellipse((x - r, y - r, x + r, y + r), fill=color, outline=edge, width=camera.line)
        rim = camera(_placed((shape.offset[0] + radius, shape.offset[1]), pose))
        draw.line((x, y, *rim), fill=edge, width=camera.line)  # shows that it turns
    elif isinstance(shape, Segment):
        draw.line((*points[0], *points[1]), fill=color, width=max(1, round(2 * r)))
        for x, y in points:
            draw.ellipse((x - r, y - r, x + r, y + r), fill=color)
    else:
        draw.polygon(points, fill=color, outline=edge, width=camera.line)


def _draw_connection(
    draw: ImageDraw.ImageDraw, camera: _Camera, scene: Scene, state: StateArray, joint: Joint
) -> None:
    """Ropes and rails as lines, springs as zigzags; a damper alone stands for friction, unseen."""
    if isinstance(joint, Groove):
        ends = [_anchor(scene, state, joint.a, joint.a, end) for end in (joint.start, joint.end)]
        draw.line([camera(end) for end in ends], fill=FAINT, width=2 * camera.line)
    elif isinstance(joint, Rope) or (isinstance(joint, Spring) and joint.stiffness > 0):
        a = camera(_anchor(scene, state, joint.a, joint.a, joint.anchor_a))
        b = camera(_anchor(scene, state, joint.b, joint.b, joint.anchor_b))
        points = [a, b] if isinstance(joint, Rope) else _zigzag(a, b, 0.008 * camera.width)
        draw.line(points, fill=INK, width=camera.line, joint="curve")


def _zigzag(a: Vec, b: Vec, half: float, turns: int = 10) -> list[Vec]:
    """A line from a to b that swings `half` to both sides."""
    along = np.array(b) - np.array(a)
    side = np.array([-along[1], along[0]]) / max(math.hypot(*along), 1e-9)
    swings = [0.0, *((-1.0) ** i for i in range(turns)), 0.0]
    shares = [0.0, *((i + 0.5) / turns for i in range(turns)), 1.0]
    points = [
        a + share * along + half * swing * side for share, swing in zip(shares, swings, strict=True)
    ]
    return [(float(x), float(y)) for x, y in points]


def _draw_pin(draw: ImageDraw.ImageDraw, camera: _Camera, anchor: Vec) -> None:
    x, y = camera(anchor)
    r = PIN_RADIUS * camera.width
    draw.ellipse((x - r, y - r, x + r, y + r), fill=BACKGROUND, outline=INK, width=camera.line)


def _draw_actions(
    draw: ImageDraw.ImageDraw,
    camera: _Camera,
    scene: Scene,
    state: StateArray,
    action: FloatArray,
) -> None:
    """Flames and arrows, as long as the action asks for, up to its bound."""
    largest = np.maximum(np.abs(scene.action_low), np.abs(scene.action_high))
    asked = np.clip(np.asarray(action, np.float64), scene.action_low, scene.action_high) / largest
    levels = {each.name: float(asked[i]) for i, each in enumerate(scene.actions)}
    for thruster in scene.thrusters:
        level = levels[thruster.action]
        if abs(level) > LEAST_ACTION:
            pose = state[scene.body_index[thruster.body]]
            _draw_flame(draw, camera, thruster, pose, level)
    for motor in scene.motors:
        level = levels[motor.action]
        if abs(level) > LEAST_ACTION:
            centre = _motor_place(scene, state, motor.a, motor.b)
            _draw_arrow(draw, camera, centre, _motor_size(scene, motor.a, motor.b), level)


def _draw_flame(
    draw: ImageDraw.ImageDraw,
    camera: _Camera,
    thruster: Thruster,
    pose: StateArray,
    level: float,
) -> None:
    """A flame opposite to the thruster's force."""
    back = -np.array(thruster.direction) / math.hypot(*thruster.direction) * math.copysign(1, level)
    side = np.array([-back[1], back[0]])
    length = FLAME_LENGTH * camera.metres * abs(level)
    half = 0.2 * FLAME_LENGTH * camera.metres * (0.5 + 0.5 * abs(level))
    # (way back, way to the side) of half of the outline
    profile = ((0.0, 0.55), (0.12, 0.9), (0.3, 1.0), (0.6, 0.6), (1.0, 0.0))
    for size, color in ((1.0, FLAME), (0.5 * abs(level), FLAME_CORE)):
        halves = [
            [
                sign * width * half * size * side + way * length * size * back
                for way, width in profile
            ]
            for sign in (1, -1)
        ]
        outline = [*halves[0], *reversed(halves[1])]
        points = [(thruster.point[0] + x, thruster.point[1] + y) for x, y in outline]
        draw.polygon([camera(_placed(point, pose)) for point in points], fill=color)


def _draw_arrow(
    draw: ImageDraw.ImageDraw, camera: _Camera, centre: Vec, size_m: float, level: float
) -> None:
    """An arrow round a joint in the sense in which the motor turns its second body."""
    x, y = camera(centre)
    least, most = (share * camera.width for share in ARROW_RADIUS)
    r = min(max(0.6 * size_m * camera.scale, least), most)
    sweep = 60 + 200 * abs(level)
    # Pillow counts degrees clockwise from the right; the arrow starts at the bottom.
    end = 90 - math.copysign(sweep, level)
    thick = round(0.3 * r)
    start, stop = min(end, 90), max(end, 90)
    draw.arc((x - r, y - r, x + r, y + r), start, stop, fill=MOTOR, width=thick)
    a = math.radians(end)
    out = np.array([math.cos(a), math.sin(a)])
    ahead = np.array([out[1], -out[0]]) * math.copysign(1, level)
    middle = np.array([x, y]) + (r - thick / 2) * out
    tip, inner, outer = middle + 0.75 * r * ahead, middle - 0.42 * r * out, middle + 0.42 * r * out
    draw.polygon([(float(p[0]), float(p[1])) for p in (tip, inner, outer)], fill=MOTOR)


def _motor_size(scene: Scene, a: str, b: str) -> float:
    """Side (m) of a square as large as the smaller of the bodies that a motor turns."""
    indices = [scene.body_index[name] for name in (a, b) if name in scene.body_index]
    areas = [sum(shape.area for shape in scene.bodies[index].shapes) for index in indices]
    return math.sqrt(min(areas))


def _motor_place(scene: Scene, state: StateArray, a: str, b: str) -> Vec:
    """The hinge that a motor turns, or else the origin of its second body."""
    for joint in scene.joints:
        if isinstance(joint, Pivot) and {joint.a, joint.b} == {a, b}:
            return _anchor(scene, state, joint.b, joint.a, joint.anchor)
    x, y = state[scene.body_index[b]][:2]
    return (float(x), float(y))


def _anchor(scene: Scene, state: StateArray, name: str, other: str, anchor: Vec) -> Vec:
    """Where an anchor is now that was declared on the body `name` (or on `other`) at its start."""
    index = scene.body_index.get(name, scene.body_index.get(other))
    if index is None:
        return anchor  # both are the world
    body: Body = scene.bodies[index]
    dx, dy = anchor[0] - body.position[0], anchor[1] - body.position[1]
    c, s = math.cos(-body.angle), math.sin(-body.angle)
    return _placed((c * dx - s * dy, s * dx + c * dy), state[index])
