"""Training several policies: one vmapped program against one after the other.

    python benchmarks/several_seeds.py [--policies 2 4] [--batch 256] [--rounds 9]

The network of the recipe `standard` (Mixer, 2 layers, 64 channels, H = 8). Steps run inside a
compiled loop, as in training; all candidates do the same number of gradient steps per policy.
Ratios above 1 mean that the vmapped program is faster.
"""

import argparse
import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax
from alternated import measure, show_medians, show_ratio

from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig

OPTIMISER = optax.chain(optax.clip_by_global_norm(10.0), optax.adamw(1e-3, weight_decay=1e-2))
STEPS = 10
NETWORK = (("layers", 2), ("channels", 64), ("channel_hidden", 128), ("token_hidden", 32))


def steps_of(policy: Policy) -> Any:
    """Return (params, state, batch) -> the losses of STEPS optimizer steps, not yet compiled."""

    def step(carry: Any, batch: Any) -> Any:
        params, state = carry
        mine = dataclasses.replace(policy, params=params)
        value, gradient = mine.loss_and_gradient(*batch, None)
        updates, state = OPTIMISER.update(gradient, state, params)
        return (optax.apply_updates(params, updates), state), value

    def steps(params: Any, state: Any, batch: Any) -> Any:
        def again(carry: Any, _: None) -> Any:
            return step(carry, batch)

        return jax.lax.scan(again, (params, state), None, length=STEPS)

    return steps


def candidates(count: int, batch: int) -> dict[str, Any]:
    obs_dim, action_dim = 11, 4
    config = PolicyConfig("mixer", NETWORK, horizon=8, obs_dim=obs_dim, action_dim=action_dim)
    policies = [
        Policy.init(config, Normaliser.identity(obs_dim, action_dim), jax.random.key(i))
        for i in range(count)
    ]
    steps = steps_of(policies[0])
    inputs = []
    for i, policy in enumerate(policies):
        keys = jax.random.split(jax.random.key(100 + i), 3)
        data = (
            jax.random.normal(keys[0], (batch, obs_dim)),
            jax.random.normal(keys[1], (batch, 8, action_dim)),
            jnp.ones((batch, 8), bool),
            keys[2],
        )
        inputs.append((policy.params, OPTIMISER.init(policy.params), data))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *inputs)
    single, together = jax.jit(steps), jax.jit(jax.vmap(steps))

    def one_by_one() -> Any:
        return [single(*own) for own in inputs]

    expected = [losses[-1] for _, losses in one_by_one()]
    found = together(*stacked)[1][:, -1]
    if not jnp.allclose(jnp.stack(expected), found, rtol=1e-3):
        raise SystemExit(f"the losses differ: {expected} and {found}")
    return {
        f"{count} one after the other": one_by_one,
        f"{count} in one program": functools.partial(together, *stacked),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policies", type=int, nargs="+", default=[2, 4])
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args()
    for count in options.policies:
        samples = measure(candidates(count, options.batch), options.rounds)
        show_medians(samples)
        show_ratio(samples, f"{count} one after the other", f"{count} in one program", 1.0)


if __name__ == "__main__":
    main()
