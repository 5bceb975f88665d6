"""Training over several devices: the same numbers as on one, up to rounding. Devices are forced."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

HELPERS = Path(__file__).parents[1] / "helpers"

SCRIPT = """
import json
import jax, jax.numpy as jnp, numpy as np
from rtc_cli.core.delays import DelayDistribution
from random_weights import random_policy
from rtc_cli.core.policy import Normaliser, PolicyConfig
from rtc_cli.data.chunks import ChunkData
from rtc_cli.recipe import TrainConfig
from rtc_cli.training import loop

rng = np.random.default_rng(7)
data = ChunkData(
    rng.normal(size=(70, 3)).astype(np.float32),
    rng.normal(size=(70, 4, 2)).astype(np.float32),
    rng.random((70, 4)) < 0.9,
)
sizes = (("layers", 1), ("channels", 8), ("channel_hidden", 8), ("token_hidden", 4))
normaliser = Normaliser.from_data(data.observations, data.actions, data.valid)
policy = random_policy(PolicyConfig("mixer", sizes, 4, 3, 2), normaliser)
config = TrainConfig(batch=16, epochs=2, learning_rate=0.01, warmup_steps=3)
delays = DelayDistribution.exponential((0, 1, 2))
result = loop.fit(policy, data, config, seed=5, delays=delays)


def devices_of(batch):
    mesh = loop.data_mesh(batch)
    return 1 if mesh is None else len(mesh.devices)


mesh = loop.data_mesh(config.batch)
run = loop._Run(
    policy, data, loop.Optimisation.from_config(config, 8), delays, None, (0, 1), mesh
)
start = loop.initial_state(policy.params, config, 5)
program = loop._run_segment.lower(
    *run._epoch_inputs(start), jnp.int32(0), jnp.int32(1), **run.advance.keywords
)
text = program.compile().as_text() if mesh is not None else ""
print(json.dumps({
    "devices": devices_of(16),
    "devices_of": {batch: devices_of(batch) for batch in (6, 5, 12)},
    "reduces": "all-reduce" in text,
    "loss": [metrics.loss for metrics in result.history],
    "params": np.concatenate(
        [np.asarray(leaf).ravel() for leaf in jax.tree.leaves(result.state.params)]
    ).tolist(),
}))
"""


def train_with(devices: int) -> dict[str, object]:
    flag = f"--xla_force_host_platform_device_count={devices}"
    path = os.pathsep.join([str(HELPERS), *filter(None, [os.environ.get("PYTHONPATH")])])
    env = os.environ | {"XLA_FLAGS": flag, "JAX_PLATFORMS": "cpu", "PYTHONPATH": path}
    env["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"  # compared within tolerances: see tests/conftest.py
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        env=env, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return dict(json.loads(done.stdout.splitlines()[-1]))


def test_four_devices_compute_what_one_does() -> None:
    one, four = train_with(1), train_with(4)
    assert (one["devices"], four["devices"]) == (1, 4)
    assert four["reduces"]  # the minibatch really is split
    assert four["loss"] == pytest.approx(one["loss"], rel=1e-5)
    np.testing.assert_allclose(four["params"], one["params"], rtol=1e-3, atol=1e-5)
    # Only as many devices as divide the batch.
    assert four["devices_of"] == {"6": 2, "5": 1, "12": 4}
