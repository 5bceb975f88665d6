"""Training against a closed form, and resume after a real kill; slow."""

import os
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtc_cli.core.delays import DelayDistribution
from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig
from rtc_cli.recipe import TrainConfig
from rtc_cli.training.checkpoints import latest_progress, load_checkpoint
from rtc_cli.training.loop import fit

pytestmark = pytest.mark.slow


def optimal_velocity(x, tau, mean, std):
    """E[A − ε | x_τ = x] for A ~ N(mean, std²) and ε ~ N(0, 1), elementwise.

    (A − ε, x_τ) is jointly Gaussian with Cov(A − ε, x_τ) = τ std² − (1 − τ) and
    Var(x_τ) = τ² std² + (1 − τ)².
    """
    covariance = tau * std**2 - (1 - tau)
    variance = tau**2 * std**2 + (1 - tau) ** 2
    return mean + covariance / variance * (x - tau * mean)


@pytest.mark.parametrize("delays", [None, DelayDistribution.uniform((0, 1))])
def test_the_learned_field_is_the_optimal_one_for_gaussian_data(windows, delays):
    rng = np.random.default_rng(0)
    observations = rng.choice([-1.0, 1.0], size=(4096, 1)).astype(np.float32)
    std = 0.5
    actions = observations[:, None] + std * rng.normal(size=(4096, 2, 1)).astype(np.float32)
    data = type(windows)(observations, actions.astype(np.float32), np.ones((4096, 2), bool))
    sizes = (("layers", 1), ("channels", 32), ("channel_hidden", 64), ("token_hidden", 8))
    normaliser = Normaliser.identity(1, 1)
    policy = Policy.init(PolicyConfig("mixer", sizes, 2, 1, 1), normaliser, jax.random.key(0))
    config = TrainConfig(batch=256, epochs=80, learning_rate=3e-3, warmup_steps=50)
    trained = fit(policy, data, config, seed=0, delays=delays).policy
    observations, tau = np.repeat([[-1.0], [1.0]], 64, axis=0), np.tile(np.linspace(0, 1, 64), 2)
    tau = np.broadcast_to(tau[:, None], (128, 2))
    mean = observations[:, None]
    # Points where the path x_τ ~ N(τ mean, τ² std² + (1 − τ)²) actually goes.
    spread = np.sqrt(tau**2 * std**2 + (1 - tau) ** 2)[..., None]
    x = tau[..., None] * mean + spread * np.clip(rng.normal(size=(128, 2, 1)), -2, 2)
    learned = trained.velocity(jnp.asarray(observations))(
        jnp.asarray(x, jnp.float32), jnp.asarray(tau, jnp.float32)
    )
    error = np.asarray(learned) - optimal_velocity(x, tau[..., None], mean, std)
    target_spread = np.sqrt(1 + std**2)
    assert np.sqrt(np.mean(error**2)) < 0.15 * target_spread


_PROGRAM = """
import sys
import jax, numpy as np
from rtc_cli.core.delays import DelayDistribution
from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig
from rtc_cli.recipe import TrainConfig
from rtc_cli.training.checkpoints import (
    CheckpointMeta, latest_progress, load_checkpoint, save_progress)
from rtc_cli.training.loop import fit
from types import SimpleNamespace

root, epochs = sys.argv[1], 6
rng = np.random.default_rng(0)
data = SimpleNamespace(
    observations=rng.normal(size=(4096, 3)).astype(np.float32),
    actions=rng.normal(size=(4096, 4, 2)).astype(np.float32),
    valid=rng.random((4096, 4)) < 0.9,
)
sizes = (("layers", 1), ("channels", 32), ("channel_hidden", 32), ("token_hidden", 8))
policy = Policy.init(
    PolicyConfig("mixer", sizes, 4, 3, 2), Normaliser.identity(3, 2), jax.random.key(1))
delays = DelayDistribution.uniform((0, 1, 2))
meta = CheckpointMeta("t", "base", 0, 0, epochs, policy.config, policy.normaliser, delays, "", "")
newest = latest_progress(root)
state = load_checkpoint(newest)[0] if newest else None

def on_epoch(state, metrics):
    save_progress(root, state, meta)
    print("saved", state.epoch, flush=True)

fit(policy, data, TrainConfig(batch=32, epochs=epochs), seed=0, delays=delays, state=state,
    on_epoch=on_epoch)
"""


def start(root):
    # Only the first start compiles; a cached program has to give the same bits anyway.
    environment = os.environ | {
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(root.parent / "cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    return subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, str(root)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=environment,
    )


def finish(root):
    with start(root) as process:
        process.communicate()
    assert process.returncode == 0
    newest = latest_progress(root)
    assert newest is not None
    return load_checkpoint(newest)[0]


def test_resume_after_kill_9_gives_the_same_bits(tmp_path, same_bits):
    whole = finish(tmp_path / "whole")
    for kills, wait_s in enumerate((0.0, 0.05)):
        with start(tmp_path / "killed") as process:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("saved")
            time.sleep(wait_s)  # into the next epoch, or into the writing of its checkpoint
            process.kill()
        assert process.returncode == -signal.SIGKILL
        newest = latest_progress(tmp_path / "killed")
        assert newest is not None
        assert kills < load_checkpoint(newest)[0].epoch
    resumed = finish(tmp_path / "killed")
    assert resumed.epoch == whole.epoch == 6
    assert same_bits(resumed.params, whole.params)
    assert same_bits(resumed.opt_state, whole.opt_state)
