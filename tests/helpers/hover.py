"""A small task and an untrained policy for it: what rollouts are tested with."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import pandas as pd

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig
from rtc_cli.execution.methods import Method
from rtc_cli.execution.rollout import evaluate_cell
from rtc_cli.tasks.scene import Action, Body, Box, Circle, Jitter, Observe, Role, Scene, Thruster

HORIZON = 8
STEPS = 2


def hover_scene() -> Scene:
    """A disc between a hazardous floor and a target overhead, lifted by two weak thrusters."""
    thrusters = [
        Thruster(body="disc", action=name, max_force=9.0, point=(x, 0.0), direction=(-x, 1.0))
        for name, x in (("left", -0.1), ("right", 0.1))
    ]
    slab = {"width": 8.0, "height": 0.2}
    return Scene(
        name="hover",
        bodies=(
            Body(name="floor", static=True, shapes=(Box(**slab, role=Role.HAZARD),)),
            Body(
                name="roof",
                static=True,
                position=(0.0, 4.0),
                shapes=(Box(**slab, role=Role.TARGET),),
            ),
            Body(
                name="disc",
                position=(0.0, 2.0),
                shapes=(Circle(radius=0.3, density=4.0, role=Role.GOAL),),
            ),
        ),
        actions=(Action(name="left", low=0.0), Action(name="right", low=0.0)),
        thrusters=tuple(thrusters),
        observations=(
            Observe(kind="y", body="disc"),
            Observe(kind="vy", body="disc"),
            Observe(kind="angular_velocity", body="disc"),
        ),
        jitters=(Jitter(bodies=("disc",), position=(0.1, 0.3)),),
        bounds=(-4.0, -1.0, 4.0, 5.0),
        max_ticks=100,
    )


def hover_policy(scene: Scene) -> Policy:
    """An untrained policy of horizon 8."""
    config = PolicyConfig(
        network="mixer",
        options=(("layers", 1), ("channels", 16), ("channel_hidden", 16), ("token_hidden", 8)),
        horizon=HORIZON,
        obs_dim=scene.obs_dim,
        action_dim=scene.action_dim,
    )
    normaliser = Normaliser(
        jnp.zeros(scene.obs_dim),
        jnp.ones(scene.obs_dim),
        jnp.full(scene.action_dim, 0.75),
        jnp.full(scene.action_dim, 0.3),
    )
    init = jax.jit(lambda key: Policy.init(config, normaliser, key, adaln_zero=False))
    return init(jax.random.key(0))


def evaluate(
    scene: Scene,
    policy: Policy,
    method: Method,
    s: int,
    d: int,
    episodes: Any,
    **options: Any,
) -> pd.DataFrame:
    settings: dict[str, Any] = {"flow_steps": STEPS, "eval_seed": 3, "tile": 16} | options
    geometry = ChunkGeometry(HORIZON, s, d)
    return evaluate_cell(scene, policy, method, geometry, episodes=episodes, **settings)
