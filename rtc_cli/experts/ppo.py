"""PPO on the project's own worlds: physics outside JAX, everything else in two jitted programs.

The kept JAX libraries for PPO want an environment that JAX itself can step; these worlds step
Chipmunk. What is left of PPO is small (`update.py`), so it is written here.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from rtc_cli.errors import DivergedError
from rtc_cli.experts.policy import ExpertPolicy
from rtc_cli.experts.update import (
    Learner,
    Networks,
    Rollout,
    Statistics,
    UpdateSettings,
    draw,
    init_learner,
    update,
)
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.reward import shaped_reward
from rtc_cli.tasks.scene import Scene, Status

if TYPE_CHECKING:
    from rtc_cli.recipe import ExpertsConfig

FIRST_EPISODE_SEED = 900_000_000  # apart from the seeds of data, validation and evaluation
SEEDS_PER_EXPERT = 10_000_000
RECENT_EPISODES = 200  # success is judged over at least so many finished episodes
CONFIRMED = 0.9  # share of the target that fresh episodes have to reach before training stops


WorldsFactory = Callable[[Scene, int, int], WorldBatch]  # (scene, count, workers)


@dataclass(frozen=True)
class ExpertResult:
    """An expert and how it came about.

    success: rate over fresh episodes with sampled actions, one per world; steps: environment
    steps of training; seconds: wall-clock time of training, compilation included.
    """

    policy: ExpertPolicy
    success: float
    steps: int
    seconds: float


def train_expert(
    scene: Scene,
    config: "ExpertsConfig",
    seed: int,
    progress: Callable[[dict[str, Any]], None] | None = None,
    workers: int = 1,
    *,
    make_worlds: WorldsFactory = WorldBatch,
) -> ExpertResult:
    """Train one expert by PPO until it succeeds often enough or its steps are spent.

    Stops early when the success rate of sampled actions over the last max(200, worlds) finished
    episodes reaches `config.target_success` and one fresh episode per world confirms it: solved
    episodes are short and so the first to finish, the rate alone may be far too high. Otherwise
    the best policy by these rates is returned.
    The result depends on scene, config and seed only. `progress` gets, after each rollout, a
    record with `steps`, `max_steps`, `success` (None before 200 episodes have ended), `episodes`,
    `loss` (of the update before, None at first) and `steps_per_s`. NaN raises DivergedError.
    """
    started = time.perf_counter()
    settings = _settings(config)
    random = np.random.Generator(np.random.Philox(seed))
    learner = _init_learner(random, scene, config, settings)
    best, best_success, loss = _policy(learner, scene), 0.0, None
    with make_worlds(scene, config.worlds, workers) as worlds:
        sampler = _Sampler(scene, worlds, config, seed, random)
        while True:
            policy = _policy(learner, scene)
            rollout = sampler.rollout(policy, config.rollout_ticks)
            success = sampler.success
            if (success or 0.0) >= best_success:
                best, best_success = policy, success or 0.0
            if progress is not None:
                progress(_record(sampler, config, loss, started))
            spent = sampler.steps >= config.max_steps
            if spent or best_success >= config.target_success:
                measured = sampler.measure(best)
                if spent or measured >= CONFIRMED * config.target_success:
                    break
                best_success = measured
                sampler.start_afresh()
            draws = draw(random, rollout.reward.size, scene.action_dim, settings)
            learner, metrics = update(learner, rollout, draws, settings)
            loss = _finite_loss(metrics, scene, seed, sampler.steps)
        steps, seconds = sampler.steps, time.perf_counter() - started
        return ExpertResult(best, measured, steps, seconds)


def _settings(config: "ExpertsConfig") -> UpdateSettings:
    return UpdateSettings(
        learning_rate=config.learning_rate,
        epochs=config.epochs,
        minibatches=config.minibatches,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        rpo_alpha=config.rpo_alpha,
        entropy_weight=config.entropy,
    )


def _init_learner(
    random: np.random.Generator, scene: Scene, config: "ExpertsConfig", settings: UpdateSettings
) -> Learner:
    sizes = (scene.obs_dim, scene.action_dim, tuple(config.hidden))
    return init_learner(random, *sizes, config.init_log_std, settings)


def _policy(learner: Learner, scene: Scene) -> ExpertPolicy:
    networks: Networks = learner.networks
    statistics: Statistics = learner.statistics
    return ExpertPolicy(
        layers=networks.actor,
        obs_mean=statistics.mean,
        obs_std=statistics.std,
        log_std=networks.log_std,
        action_low=jnp.asarray(scene.action_low, jnp.float32),
        action_high=jnp.asarray(scene.action_high, jnp.float32),
    )


def _finite_loss(metrics: dict[str, jax.Array], scene: Scene, seed: int, steps: int) -> float:
    if not bool(metrics["finite"]):
        raise DivergedError(
            f"the expert of task {scene.name}, seed {seed}, diverged (NaN) after {steps} steps",
            "lower experts.learning_rate, or train with other experts.seeds",
        )
    return float(metrics["loss"])


def _record(
    sampler: "_Sampler", config: "ExpertsConfig", loss: float | None, started: float
) -> dict[str, Any]:
    return {
        "steps": sampler.steps,
        "max_steps": config.max_steps,
        "success": sampler.success,
        "episodes": sampler.episodes,
        "loss": loss,
        "steps_per_s": sampler.steps / (time.perf_counter() - started),
    }


_act = jax.jit(ExpertPolicy.act)


class _Sampler:
    """Worlds that act under a policy, each starting a new episode when its own has ended."""

    def __init__(
        self,
        scene: Scene,
        worlds: WorldBatch,
        config: "ExpertsConfig",
        seed: int,
        random: np.random.Generator,
    ) -> None:
        self.scene, self.worlds, self.count = scene, worlds, config.worlds
        self._config = config
        self.steps = 0
        self.episodes = 0
        self._recent: deque[bool] = deque(maxlen=max(RECENT_EPISODES, self.count))
        self._next_seed = FIRST_EPISODE_SEED + seed * SEEDS_PER_EXPERT
        self._random = random
        correlated = config.noise_correlation > 0
        self._last_noise = self._draw(1)[0] if correlated else None
        self.start_afresh()

    def start_afresh(self) -> None:
        """Begin a new episode in every world and forget how the latest ones ended."""
        self._recent.clear()
        self._obs = np.array(self.worlds.reset(self._seeds(self.count)), np.float32)

    @property
    def success(self) -> float | None:
        """Share of solved episodes among the latest; None before enough have ended."""
        if len(self._recent) < RECENT_EPISODES:
            return None
        return sum(self._recent) / len(self._recent)

    def rollout(self, policy: ExpertPolicy, ticks: int) -> Rollout:
        """Act for some ticks in all worlds and record what PPO needs."""
        noise = self._explore(ticks)
        obs = np.empty((ticks, self.count, self.scene.obs_dim), np.float32)
        next_obs = np.empty_like(obs)
        status = np.empty((ticks, self.count), np.int8)
        for tick in range(ticks):
            obs[tick] = self._obs
            actions = np.asarray(_act(policy, self._obs, noise[tick]))
            record = self.worlds.step(actions[:, None, :])
            next_obs[tick], status[tick] = record.obs, record.status
            self._obs = np.array(record.obs, np.float32)
            self._restart(np.flatnonzero(status[tick] != Status.RUNNING), status[tick])
        self.steps += ticks * self.count
        return self._to_rollout(obs, noise, next_obs, status)

    def measure(self, policy: ExpertPolicy) -> float:
        """Return the success rate over one fresh episode per world, whatever their lengths."""
        obs = np.array(self.worlds.reset(self._seeds(self.count)), np.float32)
        status = np.zeros(self.count, np.int8)
        noise = self._draw(self.scene.max_ticks)
        for tick in range(self.scene.max_ticks):
            active = np.flatnonzero(status == Status.RUNNING)
            if not len(active):
                break
            actions = np.asarray(_act(policy, obs, noise[tick]))
            record = self.worlds.step(actions[active, None, :], worlds=active)
            obs[active], status[active] = record.obs, record.status
        return float(np.mean(status == Status.SOLVED))

    def _restart(self, finished: np.ndarray, status: np.ndarray) -> None:
        if not len(finished):
            return
        self._recent.extend((status[finished] == Status.SOLVED).tolist())
        self.episodes += len(finished)
        self._obs[finished] = self.worlds.reset(self._seeds(len(finished)), worlds=finished)

    def _to_rollout(
        self, obs: np.ndarray, noise: np.ndarray, next_obs: np.ndarray, status: np.ndarray
    ) -> Rollout:
        invalid = status == Status.INVALID  # a world that broke: its last step teaches nothing
        next_obs[invalid] = obs[invalid]
        rows = (-1, obs.shape[-1])
        steps = obs.reshape(rows), next_obs.reshape(rows), status.reshape(-1)
        config = self._config
        reward = shaped_reward(
            self.scene,
            *steps,
            progress_scale=config.progress_scale,
            solved_reward=config.solved_reward,
            failure_cost=config.failure_cost,
        ).reshape(status.shape)
        return Rollout(
            obs=jnp.asarray(obs),
            noise=jnp.asarray(noise),
            reward=jnp.asarray(reward, jnp.float32),
            next_obs=jnp.asarray(next_obs),
            terminal=jnp.asarray((status != Status.RUNNING) & (status != Status.TIMEOUT)),
            done=jnp.asarray(status != Status.RUNNING),
        )

    def _explore(self, ticks: int) -> np.ndarray:
        """Exploration noise (ticks, N, A): standard normal, with the correlation asked for.

        Source: Hollenstein et al. 2024 (correlated noise in PPO); here of first order.
        """
        noise = self._draw(ticks)
        if self._last_noise is None:
            return noise
        keep = np.float32(self._config.noise_correlation)
        fresh = np.sqrt(1 - keep**2)
        for tick in range(ticks):
            noise[tick] = keep * self._last_noise + fresh * noise[tick]
            self._last_noise = noise[tick]
        return noise

    def _draw(self, ticks: int) -> np.ndarray:
        shape = (ticks, self.count, self.scene.action_dim)
        return self._random.standard_normal(shape, np.float32)

    def _seeds(self, count: int) -> np.ndarray:
        seeds = np.arange(self._next_seed, self._next_seed + count, dtype=np.int64)
        self._next_seed += count
        return seeds
