"""A small Kinetix level of our own, as the dictionary that its JSON file holds."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

Content = dict[str, Any]
HULL_KG = 0.4 * 0.2
ARM_KG = 0.1 * 0.3
TIP_KG = 0.5 * math.pi * 0.05**2


def hover() -> Content:
    """A hull (polygon1, goal object) on two thrusters carries a jointed arm (polygon2) with a tip.

    The tip (circle0) is welded to the arm; the target (circle1) hangs above the hull, the floor
    (polygon0) is a hazard and the whole of the surroundings. Polygon3, circle2 and the last joint
    are unused slots of the lists. Constants are those of the public level files.
    """
    hull = _polygon(0.4, 0.2, (2.0, 2.0), role=1, mass=HULL_KG)
    arm = _polygon(0.1, 0.3, (2.0, 1.75), mass=ARM_KG)
    floor = _polygon(5.0, 0.4, (2.5, 0.2), role=3, collision_mode=2)
    unused = _polygon(0.0, 0.0, (0.0, 0.0)) | {"active": False, "n_vertices": 0}
    return {
        "env_state": {
            "polygon": [floor, hull, arm, unused],
            "circle": [
                _circle(0.05, (2.0, 1.6), density=0.5, mass=TIP_KG),
                _circle(0.2, (2.0, 3.0), role=2),
                _circle(0.0, (0.0, 0.0)) | {"active": False},
            ],
            "joint": [
                _joint(1, 2, (0.0, -0.1), (0.0, 0.15))
                | {"motor_on": True, "motor_has_joint_limits": True, "motor_binding": 2},
                _joint(2, 4, (0.0, -0.15), (0.0, 0.0)) | {"is_fixed_joint": True},
                _joint(0, 0, (0.0, 0.0), (0.0, 0.0)) | {"active": False},
            ],
            "thruster": [
                _thruster(1, (-0.15, -0.1), 0),
                _thruster(1, (0.15, -0.1), 1),
            ],
            "gravity": _vector((0.0, -9.81)),
        },
        "env_params": {
            "dt": 1 / 60,
            "slop": 0.01,
            "baumgarte_coefficient_joints_v": 2.0,
            "baumgarte_coefficient_joints_p": 0.7,
            "baumgarte_coefficient_fjoint_av": 2.0,
            "baumgarte_coefficient_rjoint_limit_av": 5.0,
            "baumgarte_coefficient_collision": 0.2,
            "joint_stiffness": 0.6,
            "clip_position": 15,
            "clip_velocity": 100,
            "clip_angular_velocity": 50,
            "base_motor_speed": 6.0,
            "base_motor_power": 900.0,
            "base_thruster_power": 10.0,
            "motor_decay_coefficient": 0.1,
            "motor_joint_limit": 0.1,
            "base_friction": 0.4,
            "max_timesteps": 256,
            "pixels_per_unit": 100,
            "dense_reward_scale": 0.1,
            "num_shape_roles": 4,
        },
        "static_env_params": {
            "num_polygons": 4,
            "num_circles": 3,
            "num_joints": 3,
            "num_thrusters": 2,
            "max_polygon_vertices": 4,
            "num_solver_iterations": 10,
            "solver_batch_size": 16,
            "do_warm_starting": True,
            "num_static_fixated_polys": 1,
            "screen_dim": {"0": 500, "1": 500},
            "downscale": 4,
            "frame_skip": 2,
            "max_shape_size": 2,
            "num_motor_bindings": 4,
            "num_thruster_bindings": 2,
        },
    }


def write_level(folder: Path, content: Any, name: str = "hover") -> Path:
    """Write a level file and return its path."""
    path = folder / f"{name}.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def _vector(pair: tuple[float, float]) -> Content:
    return {"0": pair[0], "1": pair[1]}


def _body(position: tuple[float, float], mass: float, moment: float) -> Content:
    return {
        "active": True,
        "position": _vector(position),
        "rotation": 0.0,
        "velocity": _vector((0.0, 0.0)),
        "angular_velocity": 0.0,
        "inverse_mass": 1.0 / mass if mass else 0.0,
        "inverse_inertia": 1.0 / moment if mass else 0.0,
        "density": 1.0,
        "friction": 1.0,
        "restitution": 0.0,
        "collision_mode": 1,
        "role": 0,
        "radius": 0.0,
    }


def _polygon(
    width: float, height: float, position: tuple[float, float], mass: float = 0.0, **more: Any
) -> Content:
    w, h = width / 2, height / 2
    corners = ((w, h), (w, -h), (-w, -h), (-w, h))
    body = _body(position, mass, mass * (width**2 + height**2) / 12)
    vertices = {str(i): _vector(corner) for i, corner in enumerate(corners)}
    return body | {"n_vertices": 4, "vertices": vertices} | more


def _circle(
    radius: float, position: tuple[float, float], mass: float = 0.0, **more: Any
) -> Content:
    return _body(position, mass, mass * radius**2 / 2) | {"radius": radius} | more


def _joint(a: int, b: int, on_a: tuple[float, float], on_b: tuple[float, float]) -> Content:
    return {
        "active": True,
        "a_index": a,
        "b_index": b,
        "a_relative_pos": _vector(on_a),
        "b_relative_pos": _vector(on_b),
        "motor_on": False,
        "motor_speed": 1.0,
        "motor_power": 1.0,
        "motor_binding": 0,
        "motor_has_joint_limits": False,
        "min_rotation": -1.0,
        "max_rotation": 1.0,
        "is_fixed_joint": False,
        "rotation": 0.0,
    }


def _thruster(body: int, point: tuple[float, float], binding: int) -> Content:
    return {
        "active": True,
        "object_index": body,
        "relative_position": _vector(point),
        "rotation": math.pi / 2,
        "power": 0.15,
        "thruster_binding": binding,
    }
