"""The pure part of PPO: advantages, loss and one whole update as a single program.

Source: Schulman et al. 2017 (PPO), Schulman et al. 2016 (GAE), Rahman and Xue 2022 (RPO: noise
on the mean in the update keeps the policy from narrowing too early).
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from rtc_cli.experts.policy import Layers, mlp, normalise

RATIO_CLIP = 0.2
VALUE_WEIGHT = 0.5
MAX_GRADIENT_NORM = 0.5
ADAM_EPS = 1e-5


@dataclass(frozen=True)
class UpdateSettings:
    """What an update depends on beside its data; hashable, a static argument."""

    learning_rate: float
    epochs: int
    minibatches: int
    gamma: float
    gae_lambda: float
    rpo_alpha: float
    entropy_weight: float

    def optimizer(self) -> optax.GradientTransformation:
        clip = optax.clip_by_global_norm(MAX_GRADIENT_NORM)
        adam = optax.adam(self.learning_rate, eps=ADAM_EPS)
        return optax.flatten(optax.chain(clip, adam))  # one array compiles faster


class Networks(NamedTuple):
    """Trained parameters: mean of the policy, its log standard deviation (A,), the value."""

    actor: Layers
    log_std: jax.Array
    critic: Layers


class Statistics(NamedTuple):
    """Running moments of observations: total (), mean (O,), variance (O,)."""

    total: jax.Array
    mean: jax.Array
    variance: jax.Array

    @property
    def std(self) -> jax.Array:
        return jnp.sqrt(self.variance + 1e-6)


class Learner(NamedTuple):
    """All that an update reads and writes."""

    networks: Networks
    optimizer: optax.OptState
    statistics: Statistics


class Draws(NamedTuple):
    """The randomness of one update, of S steps with R rows each, drawn outside the program.

    rows: (S, R) int32, the rows of each minibatch; shift: (S, R, A) float32, uniform in [-1, 1],
    for RPO.
    """

    rows: jax.Array
    shift: jax.Array


class Rollout(NamedTuple):
    """T ticks in N worlds. `next_obs` is what followed, before any reset.

    obs, next_obs: (T, N, O); noise: (T, N, A) standard normals behind the actions; reward: (T, N);
    terminal: (T, N) bool, nothing follows; done: (T, N) bool, the episode ends here (a timeout is
    done but not terminal: its value is bootstrapped).
    """

    obs: jax.Array
    noise: jax.Array
    reward: jax.Array
    next_obs: jax.Array
    terminal: jax.Array
    done: jax.Array


class _Rows(NamedTuple):
    x: jax.Array  # (R, O) normalised observations
    u: jax.Array  # (R, A) actions before the squashing
    log_prob: jax.Array  # (R,) when they were taken
    advantage: jax.Array  # (R,)
    target: jax.Array  # (R,) of the value


def init_learner(
    random: np.random.Generator,
    obs_dim: int,
    action_dim: int,
    hidden: tuple[int, ...],
    init_log_std: float,
    settings: UpdateSettings,
) -> Learner:
    """Return a learner with orthogonal weights; the policy starts near mean zero."""
    networks = Networks(
        actor=_init_mlp(random, (obs_dim, *hidden, action_dim), last_gain=0.01),
        log_std=jnp.asarray(np.full(action_dim, init_log_std, np.float32)),
        critic=_init_mlp(random, (obs_dim, *hidden, 1), last_gain=1.0),
    )
    start = (np.zeros(()), np.zeros(obs_dim), np.ones(obs_dim))
    statistics = Statistics(*(jnp.asarray(array.astype(np.float32)) for array in start))
    return Learner(networks, settings.optimizer().init(networks), statistics)


def _init_mlp(random: np.random.Generator, sizes: tuple[int, ...], last_gain: float) -> Layers:
    gains = [2.0**0.5] * (len(sizes) - 2) + [last_gain]
    layers = []
    for gain, before, after in zip(gains, sizes[:-1], sizes[1:], strict=True):
        square = random.standard_normal((max(before, after), min(before, after)))
        columns, _ = np.linalg.qr(square)
        weights = gain * (columns if before >= after else columns.T)
        layers.append((jnp.asarray(weights, jnp.float32), jnp.zeros(after, jnp.float32)))
    return tuple(layers)


def draw(
    random: np.random.Generator, rows: int, action_dim: int, settings: UpdateSettings
) -> Draws:
    """Draw the minibatches of every epoch and RPO's shifts of the mean.

    Rows that do not fill the last minibatch are left out of that epoch. (NumPy, because compiling
    XLA's sort takes longer than many updates.)
    """
    size = rows // settings.minibatches
    orders = [
        random.permutation(rows)[: size * settings.minibatches] for _ in range(settings.epochs)
    ]
    index = np.stack(orders).astype(np.int32).reshape(-1, size)
    shift = 2.0 * random.random((*index.shape, action_dim), np.float32) - 1.0
    return Draws(jnp.asarray(index), jnp.asarray(shift))


def gae(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminal: jax.Array,
    done: jax.Array,
    gamma: float,
    gae_lambda: float,
) -> jax.Array:
    """Generalised advantage estimation over time, all arguments (T, N).

    δ_t = r_t + γ (1 − terminal_t) V(next_t) − V_t;  A_t = δ_t + γ λ (1 − done_t) A_{t+1}.
    """
    delta = reward + gamma * jnp.where(terminal, 0.0, next_value) - value
    decay = gamma * gae_lambda * (1.0 - done.astype(value.dtype))

    def backwards(
        later: jax.Array, now: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        advantage = now[0] + now[1] * later
        return advantage, advantage

    _, advantages = jax.lax.scan(backwards, jnp.zeros_like(delta[0]), (delta, decay), reverse=True)
    return advantages


def merge(statistics: Statistics, obs: jax.Array) -> Statistics:
    """Add observations (R, O) to running moments (Chan et al. 1979)."""
    total = statistics.total + obs.shape[0]
    shift = jnp.mean(obs, axis=0) - statistics.mean
    share = obs.shape[0] / total
    variance = (
        (1.0 - share) * statistics.variance
        + share * jnp.var(obs, axis=0)
        + share * (1.0 - share) * shift**2
    )
    return Statistics(total, statistics.mean + share * shift, variance)


@partial(jax.jit, static_argnames="settings")
def update(
    learner: Learner, rollout: Rollout, draws: Draws, settings: UpdateSettings
) -> tuple[Learner, dict[str, jax.Array]]:
    """One PPO update: advantages, then epochs × minibatches in one scan.

    Metrics: `loss`, its mean over the steps, and `finite` (bool: loss and parameters are).
    """
    rows = _prepare(learner, rollout, settings)
    optimizer = settings.optimizer()

    def step(
        carry: tuple[Networks, optax.OptState], draws: Draws
    ) -> tuple[tuple[Networks, optax.OptState], jax.Array]:
        networks, state = carry
        batch = jax.tree.map(lambda array: array[draws.rows], rows)
        loss, gradient = jax.value_and_grad(_loss)(networks, batch, draws.shift, settings)
        changes, state = optimizer.update(gradient, state, networks)
        return (optax.apply_updates(networks, changes), state), loss

    (networks, state), losses = jax.lax.scan(step, (learner.networks, learner.optimizer), draws)
    statistics = merge(learner.statistics, rollout.obs.reshape(-1, rollout.obs.shape[-1]))
    # A sum is finite only where every term is; NaN in a parameter shows in the next loss too.
    total = sum(jnp.sum(leaf) for leaf in jax.tree.leaves((networks, losses)))
    finite = jnp.isfinite(total) & jnp.all(jnp.isfinite(statistics.mean))
    return Learner(networks, state, statistics), {"loss": jnp.mean(losses), "finite": finite}


def _prepare(learner: Learner, rollout: Rollout, settings: UpdateSettings) -> _Rows:
    networks, statistics = learner.networks, learner.statistics
    x = normalise(rollout.obs, statistics.mean, statistics.std)
    next_x = normalise(rollout.next_obs, statistics.mean, statistics.std)
    value = mlp(networks.critic, x)[..., 0]
    next_value = mlp(networks.critic, next_x)[..., 0]
    advantage = gae(
        rollout.reward,
        value,
        next_value,
        rollout.terminal,
        rollout.done,
        settings.gamma,
        settings.gae_lambda,
    )
    u = mlp(networks.actor, x) + jnp.exp(networks.log_std) * rollout.noise
    log_prob = -jnp.sum(0.5 * rollout.noise**2 + networks.log_std, axis=-1)
    rows = _Rows(x, u, log_prob, advantage, advantage + value)
    return jax.tree.map(lambda array: array.reshape(-1, *array.shape[2:]), rows)


def _loss(networks: Networks, rows: _Rows, shift: jax.Array, settings: UpdateSettings) -> jax.Array:
    mean = mlp(networks.actor, rows.x) + settings.rpo_alpha * shift
    z = (rows.u - mean) * jnp.exp(-networks.log_std)
    log_prob = -jnp.sum(0.5 * z**2 + networks.log_std, axis=-1)
    ratio = jnp.exp(log_prob - rows.log_prob)
    advantage = rows.advantage - jnp.mean(rows.advantage)
    advantage = advantage / (jnp.std(advantage) + 1e-8)
    clipped = jnp.clip(ratio, 1.0 - RATIO_CLIP, 1.0 + RATIO_CLIP)
    policy_loss = -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
    value_loss = 0.5 * jnp.mean((mlp(networks.critic, rows.x)[..., 0] - rows.target) ** 2)
    entropy = jnp.sum(networks.log_std)  # of the Gaussian, up to a constant
    return policy_loss + VALUE_WEIGHT * value_loss - settings.entropy_weight * entropy
