"""Compares four motions of the Kinetix port with closed forms; draws docs/kinetix/motions.svg.

    python docs/make_kinetix.py

Prints the table that docs/kinetix.md shows. Free fall, a thruster burst, a motor spin-up and a
bounce go the whole way from the records of a level file through the scene to the fast engine;
action noise is off.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.kinetix.building import build_scene
from rtc_cli.tasks.kinetix.reading import Laws, Level, LevelJoint, LevelShape, LevelThruster
from rtc_cli.tasks.scene import SUBSTEP_S, SUBSTEPS, Role

FIGURE = Path(__file__).parent / "kinetix" / "motions.svg"
G = 9.81
Array = npt.NDArray[np.float64]

LAWS = Laws(
    max_ticks=256,
    motor_speed=6.0,
    motor_power=900.0,
    motor_softness=0.1,
    motor_fade=0.1,
    thruster_power=10.0,
    friction=0.4,
    max_speed=100.0,
    max_spin=50.0,
    gravity=(0.0, -G),
)
BALL = LevelShape(
    name="ball",
    place="ball",
    position=(1.0, 4.0),
    rotation=0.0,
    velocity=(0.0, 0.0),
    spin=0.0,
    inverse_mass=10.0,
    inverse_inertia=2000.0,
    density=1.0,
    friction=1.0,
    restitution=0.0,
    mode=1,
    role=Role.GOAL,
    radius=0.1,
)
STATIC = {"inverse_mass": 0.0, "inverse_inertia": 0.0}
TARGET = dataclasses.replace(BALL, name="target", role=Role.TARGET, position=(4.5, 4.5), **STATIC)


@dataclass(frozen=True)
class Motion:
    """One quantity over time: ours at control steps, and the closed form as a function of seconds.

    `per_substep`, where given, is the law summed up substep by substep, as a computer does it.
    """

    title: str
    unit: str
    time: Array
    ours: Array
    closed: Callable[[Array], Array]
    per_substep: Array | None = None

    @property
    def error(self) -> float:
        """Largest difference from the closed form."""
        return float(np.abs(self.ours - self.closed(self.time)).max())

    @property
    def step_error(self) -> float | None:
        """Largest difference from the sum over substeps."""
        if self.per_substep is None:
            return None
        return float(np.abs(self.ours - self.per_substep).max())


def record(level: Level, actions: Sequence[float], ticks: int) -> Array:
    """States (ticks + 1, 6) of the first shape of a level under one action component by tick."""
    scene = dataclasses.replace(build_scene(level, "lab"), action_noise=0.0)
    with WorldBatch(scene, 1) as worlds:
        worlds.reset([0])
        states = [worlds.states[0, 0]]
        for tick in range(ticks):
            action = np.zeros((1, 1, scene.action_dim), np.float32)
            action[0, 0, 0] = actions[min(tick, len(actions) - 1)]
            worlds.step(action)
            states.append(worlds.states[0, 0])
    return np.array(states)


def lab(
    ball: LevelShape,
    others: Sequence[LevelShape] = (),
    joints: Sequence[LevelJoint] = (),
    gravity: float = -G,
    thrust: float = 0.0,
) -> Level:
    """A level of one moving ball (number 0), the target (1) and other shapes (from 2 on)."""
    laws = dataclasses.replace(LAWS, gravity=(0.0, gravity))
    thruster = LevelThruster(body=0, point=(0.0, 0.0), angle=0.0, power=thrust, binding=0)
    shapes = dict(enumerate([ball, TARGET, *others]))
    return Level(Path("lab.json"), laws, shapes, tuple(joints), (thruster,))


def times(ticks: int) -> Array:
    """Seconds at control steps 0 to `ticks`."""
    return np.arange(ticks + 1) * SUBSTEPS * SUBSTEP_S


def free_fall(ticks: int = 24) -> Motion:
    """Height of a ball thrown up at 1 m/s."""
    ball = dataclasses.replace(BALL, velocity=(0.5, 1.0))
    t = times(ticks)
    # Chipmunk moves a body with the velocity that it had before the substep's forces.
    substeps = np.arange(ticks + 1) * SUBSTEPS
    summed = 4.0 + t - G * SUBSTEP_S**2 * substeps * (substeps - 1) / 2
    ours = record(lab(ball), [0.0], ticks)[:, 1]
    return Motion("Free fall", "height (m)", t, ours, lambda t: 4.0 + t - G * t**2 / 2, summed)


def thruster_burst(ticks: int = 24, burst: int = 12) -> Motion:
    """Place of a ball without weight that a thruster pushes for `burst` control steps, then not."""
    force, mass = 10.0 * 0.05, 0.1
    end = burst * SUBSTEPS * SUBSTEP_S

    def closed(t: Array) -> Array:
        pushed = np.minimum(t, end)
        return 1.0 + force / mass * (pushed**2 / 2 + end * (t - pushed))

    ours = record(lab(BALL, gravity=0.0, thrust=0.05), [1.0] * burst + [0.0], ticks)[:, 0]
    return Motion("Thruster burst", "place (m)", times(ticks), ours, closed)


def motor_spin_up(ticks: int = 15) -> Motion:
    """Spin of a wheel on the wall whose motor is told to turn at 6 rad/s."""
    hub = dataclasses.replace(BALL, name="hub", role=Role.NONE, **STATIC)
    joint = LevelJoint("joint", 2, 0, (0.0, 0.0), (0.0, 0.0), False, 0.0, None, (0, 1.0, 1.0))
    ours = record(lab(BALL, [hub], [joint]), [1.0], ticks)[:, 5]

    def closed(t: Array) -> Array:
        return 6.0 + 10.0 * np.arcsinh(np.sinh(0.1 * -6.0) * np.exp(-900.0 * 0.1 * t))

    spin, summed = 0.0, [0.0]
    for _ in range(ticks):
        for _ in range(SUBSTEPS):
            spin -= 900.0 * SUBSTEP_S * math.tanh(0.1 * (spin - 6.0))
        summed.append(spin)
    return Motion("Motor spin-up", "spin (rad/s)", times(ticks), ours, closed, np.array(summed))


def bounce(ticks: int = 66, restitution: float = 0.8) -> Motion:
    """Height of a ball dropped from 1 m above the floor, restitution 0.8."""
    corners = ((2.0, 0.0), (2.0, -1.0), (-2.0, -1.0), (-2.0, 0.0))
    floor = dataclasses.replace(
        BALL, name="floor", role=Role.NONE, position=(2.0, 0.0), vertices=corners, **STATIC
    )
    floor = dataclasses.replace(floor, restitution=1.0, radius=0.0)
    ball = dataclasses.replace(BALL, position=(1.0, 1.1), restitution=restitution)
    height = record(lab(ball, [floor]), [0.0], ticks)[:, 1] - 0.1

    def closed(t: Array) -> Array:
        return np.array([_bounced(float(each), 1.0, restitution) for each in t])

    return Motion("Bounce", "height above the floor (m)", times(ticks), height, closed)


def _bounced(t: float, height: float, restitution: float) -> float:
    """Height of a point dropped from `height` after `t` seconds and any number of bounces."""
    fall = math.sqrt(2 * height / G)
    if t <= fall:
        return height - G * t**2 / 2
    t, speed = t - fall, restitution * G * fall
    while t > 2 * speed / G:
        t, speed = t - 2 * speed / G, restitution * speed
    return speed * t - G * t**2 / 2


def motions() -> list[Motion]:
    """The four of the page."""
    return [free_fall(), thruster_burst(), motor_spin_up(), bounce()]


def peaks(motion: Motion) -> list[float]:
    """Heights of the tops of a bouncing motion after the first contact."""
    y = motion.ours
    return [float(y[i]) for i in range(1, len(y) - 1) if y[i - 1] < y[i] >= y[i + 1]]


def draw(found: Sequence[Motion], path: Path) -> None:
    """One panel a motion: our points on the closed form's line."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "kinetix"
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 4, figsize=(13, 3.2), layout="constrained")
    for axes, motion in zip(panels, found, strict=True):
        fine = np.linspace(0.0, motion.time[-1], 400)
        axes.plot(fine, motion.closed(fine), color="#5b636d", lw=1.5, label="closed form")
        axes.plot(motion.time, motion.ours, "o", color="#0072b2", ms=3.5, label="this port")
        axes.set(title=motion.title, xlabel="time (s)", ylabel=motion.unit)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].legend(frameon=False)
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, metadata={"Date": None})
    pyplot.close(figure)


def table(found: Sequence[Motion]) -> str:
    """The numbers in Markdown."""
    lines = ["| motion | seconds | from the closed form | from the sum over substeps |"]
    lines.append("| --- | --- | --- | --- |")
    for motion in found:
        summed = "" if motion.step_error is None else f"{motion.step_error:.0e}"
        unit = motion.unit.split("(")[1].rstrip(")")
        cells = (
            motion.title.lower(),
            f"{motion.time[-1]:.1f}",
            f"{motion.error:.3f} {unit}",
            summed,
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    measured = motions()
    draw(measured, FIGURE)
    print(table(measured))
    tops = ", ".join(f"{top:.3f}" for top in peaks(measured[3]))
    print(f"tops of the bounces: {tops} m; closed form {0.8**2:.3f}, {0.8**4:.3f}, {0.8**6:.3f} m")
