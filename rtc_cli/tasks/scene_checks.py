"""What a scene must satisfy; everything else would fail later and less clearly."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from rtc_cli.errors import UsageError, did_you_mean
from rtc_cli.tasks.measuring import COMPONENTS

if TYPE_CHECKING:
    from rtc_cli.tasks.scene import Body, Observe, Scene


def check_scene(scene: Scene) -> None:
    """Refuse names that do not exist and numbers that cannot work."""
    where = f'scene "{scene.name}": '
    bodies = [body.name for body in scene.bodies]
    moving = [body.name for body in scene.bodies if not body.static]
    _unique(where + "body", bodies)
    _unique(where + "action", [a.name for a in scene.actions])
    _unique(where + "observation", [entry.label for entry in scene.observations])
    if "world" in bodies:
        raise UsageError(f'{where}a body is called "world", which is reserved. Rename it.')
    if not moving or not scene.actions or not scene.observations:
        raise UsageError(f"{where}needs a body that moves, an action and an observation.")
    for body in scene.bodies:
        _check_body(where, body)
    for action in scene.actions:
        if not action.low < action.high:
            raise UsageError(
                f'{where}action "{action.name}" has bounds {action.low}, {action.high};'
                " low must be below high."
            )
    _check_links(where, scene, [*bodies, "world"], moving)
    for jitter in scene.jitters:
        _known(where + "jitter", jitter.bodies, moving)
    for entry in scene.observations:
        _check_observation(where, entry, bodies)
    for term in scene.progress_terms:
        scene.columns(term.observation)


def _check_links(where: str, scene: Scene, bodies: list[str], moving: list[str]) -> None:
    """Joints, motors and thrusters hold on to bodies and actions that exist."""
    links = [(j.a, j.b) for j in scene.joints] + [(m.a, m.b) for m in scene.motors]
    for a, b in links:
        _known(where + "joint or motor", (a, b), bodies)
        if a not in moving and b not in moving:
            raise UsageError(f'{where}a joint of "{a}" and "{b}" needs a moving body.')
    _known(where + "thruster", [t.body for t in scene.thrusters], moving)
    driven = [m.action for m in scene.motors] + [t.action for t in scene.thrusters]
    _known(where + "motor or thruster action", driven, [a.name for a in scene.actions])


def _check_body(where: str, body: Body) -> None:
    if not body.shapes and not body.static:
        raise UsageError(f'{where}body "{body.name}" moves but has no shape. Add one.')
    for shape in body.shapes:
        if not body.static and not shape.density > 0:
            raise UsageError(
                f'{where}body "{body.name}" has a shape of density {shape.density};'
                " a moving body needs more than 0."
            )


def _check_observation(where: str, entry: Observe, bodies: list[str]) -> None:
    if entry.kind not in COMPONENTS:
        raise UsageError(
            f'{where}observation kind "{entry.kind}" is unknown.'
            + did_you_mean(entry.kind, COMPONENTS)
        )
    relative = entry.kind.startswith("relative") or entry.kind == "local_position"
    if relative != bool(entry.other):
        rule = "needs" if relative else "takes no"
        raise UsageError(f'{where}observation "{entry.label}" {rule} `other`.')
    _known(where + "observation", [entry.body, *([entry.other] if relative else [])], bodies)
    if not entry.scale > 0 or (entry.offset and len(entry.offset) != entry.size):
        raise UsageError(
            f'{where}observation "{entry.label}" has scale {entry.scale}, offset {entry.offset};'
            f" it needs a positive scale and {entry.size} offsets or none."
        )


def _unique(what: str, names: list[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f'{what} "{name}" is declared twice. Names must be unique.')


def _known(what: str, names: Iterable[str], allowed: list[str]) -> None:
    for name in names:
        if name not in allowed:
            raise UsageError(f'{what} refers to "{name}".' + did_you_mean(name, allowed))
