"""Training samples per second: our loss against one in the reference's style.

    python benchmarks/training.py [--batch 512] [--obs-dim 679] [--rounds 15]

The paper's Mixer, H = 8, action dim 6; one step is the loss, its gradient and AdamW with gradient
clipping. Steps run inside a compiled loop, as in training (and in the public reference): a program
of one step is slower. Candidates alternate round by round in one process.
"""

import argparse
import dataclasses
import functools
import statistics
from typing import Any

import jax
import jax.numpy as jnp
import optax
import reference_style
from alternated import measure, show_medians, show_ratio

from rtc_cli.core.delays import DelayDistribution
from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig

OPTIMISER = optax.chain(optax.clip_by_global_norm(10.0), optax.adamw(3e-4, weight_decay=1e-2))


STEPS = 3


@functools.partial(jax.jit, static_argnames="gradient_of")
def train_steps(params: Any, state: Any, gradient_of: Any, *inputs: Any) -> Any:
    """Return the loss before each of `STEPS` optimizer steps, parameters and optimizer state."""

    def step(carry: Any, _: None) -> Any:
        params, state = carry
        value, gradient = gradient_of(params, *inputs)
        updates, state = OPTIMISER.update(gradient, state, params)
        return (optax.apply_updates(params, updates), state), value

    (params, state), values = jax.lax.scan(step, (params, state), None, length=STEPS)
    return values, params, state


def candidates(batch: int, obs_dim: int) -> dict[str, Any]:
    config = PolicyConfig("mixer", (), horizon=8, obs_dim=obs_dim, action_dim=6)
    policy = Policy.init(config, Normaliser.identity(obs_dim, 6), jax.random.key(0))
    reference = reference_style.reference_params(policy)
    obs = jax.random.normal(jax.random.key(1), (batch, obs_dim))
    actions = jax.random.normal(jax.random.key(2), (batch, 8, 6))
    valid, key = jnp.ones((batch, 8), bool), jax.random.key(3)

    def ours(params: Any, delays: Any, obs: Any, actions: Any, valid: Any, key: Any) -> Any:
        mine = dataclasses.replace(policy, params=params)
        return mine.loss_and_gradient(obs, actions, valid, key, delays)

    without = functools.partial(_with_delays, ours, None)
    delayed = functools.partial(_with_delays, ours, DelayDistribution.exponential(range(5)))
    reference_gradient = jax.value_and_grad(reference_style.loss)
    ours_state, reference_state = OPTIMISER.init(policy.params), OPTIMISER.init(reference)
    mine = (obs, actions, valid, key)
    calls = {
        "training": lambda: train_steps(policy.params, ours_state, without, *mine),
        "training with delays": lambda: train_steps(policy.params, ours_state, delayed, *mine),
        "reference-style training": lambda: train_steps(
            reference, reference_state, reference_gradient, obs, actions, key
        ),
    }
    first = [float(calls[name]()[0][0]) for name in ("training", "reference-style training")]
    distance = abs(first[0] - first[1])
    if not distance < 1e-4:
        raise SystemExit(f"the two losses differ by {distance}")
    return calls


def _with_delays(loss: Any, delays: Any, params: Any, *inputs: Any) -> Any:
    return loss(params, delays, *inputs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=512)
    parser.add_argument("--obs-dim", type=int, default=679)
    parser.add_argument("--rounds", type=int, default=15)
    options = parser.parse_args()
    samples = measure(candidates(options.batch, options.obs_dim), options.rounds)
    show_medians(samples)
    for name, values in samples.items():
        print(f"  {name}: {1e3 * STEPS * options.batch / statistics.median(values):.0f} samples/s")
    show_ratio(samples, "reference-style training", "training", 1.8)
    show_ratio(samples, "training with delays", "training", 1.10, at_most=True)


if __name__ == "__main__":
    main()
