"""The training loop: minibatch AdamW on a policy's loss, as a pure function of seed and data.

Randomness. The keys of a run are functions of (seed, epoch, step): each epoch's key gives one
permutation of the examples and one key per step, so a run that is resumed at the end of an epoch
computes the same bits as one that was never interrupted (same machine, same thread count). Two
policies trained with the same seed see the same minibatches, noise and flow times.

Speed. An epoch is one compiled loop over minibatches; the data lie normalised in device memory.
The loop is entered in segments of about a second, so that progress can be shown and Ctrl-C
answered. One compiled program serves every segment length, so the segments, whose lengths depend
on the clock, cannot change the result.

Devices. Where there are several, each minibatch is split over them (a mesh of one axis, "data") and
parameters and data are held by all; gradients are summed across. The result then differs from that
of one device in rounding.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from rtc_cli.core.delays import DelayDistribution
from rtc_cli.core.policy import PhysicalActions
from rtc_cli.errors import DivergedError, StateError, UsageError
from rtc_cli.recipe import TrainConfig

Params = Any

DECAY_FRACTION = 0.25
"""The share of all steps, at the end, over which "linear_last_quarter" lowers the rate to zero."""

SEGMENT_SECONDS = 1.0
"""How long the compiled loop runs between two looks at the clock, about."""

_FIRST_SEGMENT_STEPS = 16

# Apart from the key from which the caller drew the initial parameters with the same seed.
_TRAINING_STREAM = 0x7472


class Examples(Protocol):
    """What `fit` reads of a data set: N chunk windows in physical units (`data.chunks.ChunkData`).

    observations (N, O) float32, actions (N, H, A) float32, valid (N, H) bool.
    """

    @property
    def observations(self) -> np.ndarray: ...
    @property
    def actions(self) -> np.ndarray: ...
    @property
    def valid(self) -> np.ndarray: ...


PolicyT = TypeVar("PolicyT", bound=Any)


@dataclass(frozen=True)
class TrainState:
    """Everything that training carries from one epoch to the next.

    params: the network's parameters (nested dict of arrays).
    opt_state: the optimizer's state, its step count included.
    key_data: (2,) uint32, the data of the run's root key; never changes.
    epoch: epochs completed; the position in the data, since the order is drawn anew each epoch.
    """

    params: Params
    opt_state: optax.OptState
    key_data: Array
    epoch: int


@dataclass(frozen=True)
class EpochMetrics:
    """One completed epoch: its number (from 1), mean loss, last learning rate and speed."""

    epoch: int
    loss: float
    learning_rate: float
    samples_per_s: float
    seconds: float


@dataclass(frozen=True)
class Progress:
    """Where a fit stands, about once a second: `step` of `steps` done, loss of the last segment."""

    epoch: int
    epochs: int
    step: int
    steps: int
    loss: float
    samples_per_s: float
    seconds_left: float


@dataclass(frozen=True)
class FitResult(Generic[PolicyT]):
    """The trained policy, the state to go on from and one record per epoch of this call."""

    policy: PolicyT
    state: TrainState
    history: tuple[EpochMetrics, ...]


@dataclass(frozen=True)
class Optimisation:
    """The settings that a compiled step depends on; hashable, so that equal fits compile once."""

    learning_rate: float
    weight_decay: float
    warmup_steps: int
    decay: str
    grad_clip: float
    batch: int
    total_steps: int

    @classmethod
    def from_config(cls, config: TrainConfig, total_steps: int) -> "Optimisation":
        names = [field.name for field in dataclasses.fields(cls) if field.name != "total_steps"]
        return cls(**{name: getattr(config, name) for name in names}, total_steps=total_steps)

    def rate(self, step: Int[Array, ""] | int) -> Float[Array, ""]:
        """Learning rate of optimizer step n (from 0), of T = total_steps:

        rate(n) = peak · min(1, (n + 1) / warmup) · min(1, (T − n) / (T / 4))

        where the last factor belongs to `decay = "linear_last_quarter"` only. Both a base policy
        and a prefix policy forked from it use the T of all epochs, so their rates are equal.
        """
        warmup = jnp.minimum(1.0, (step + 1) / max(self.warmup_steps, 1))
        if self.decay == "constant":
            return self.learning_rate * warmup
        left = (self.total_steps - step) / (DECAY_FRACTION * self.total_steps)
        return self.learning_rate * warmup * jnp.clip(left, 0.0, 1.0)

    def optimizer(self) -> optax.GradientTransformation:
        """AdamW on gradients clipped to a global norm, as in the paper (weight decay on all)."""
        return optax.chain(
            optax.clip_by_global_norm(self.grad_clip),
            optax.adamw(self.rate, weight_decay=self.weight_decay),
        )


def steps_per_epoch(examples: int, batch: int) -> int:
    """Whole minibatches in an epoch; UsageError if there is not one.

    The remainder is left out, another one in every epoch.
    """
    if batch < 1 or examples < batch:
        raise UsageError(
            f"train.batch = {batch} does not fit data of {examples} windows",
            f"set train.batch to 1..{examples}, or collect more (data.transitions)",
        )
    return examples // batch


def fork_epoch(config: TrainConfig) -> int:
    """Epochs after which the prefix policy forks from the base policy; 0 < fork < epochs."""
    delayed = max(1, round(config.epochs * config.prefix_fraction))
    if delayed >= config.epochs:
        raise UsageError(
            f"train.epochs = {config.epochs} leaves no epoch before the fork "
            f"(train.prefix_fraction = {config.prefix_fraction})",
            "set train.epochs to at least 2 and train.prefix_fraction below 1",
        )
    return config.epochs - delayed


def initial_state(params: Params, config: TrainConfig, seed: int) -> TrainState:
    """State before the first step."""
    opt_state = Optimisation.from_config(config, total_steps=1).optimizer().init(params)
    key = jax.random.fold_in(jax.random.key(seed), _TRAINING_STREAM)
    return TrainState(params, opt_state, jax.random.key_data(key), epoch=0)


def abstract_opt_state(params: Params) -> optax.OptState:
    """Shapes and structure of the optimizer's state; the same whatever the settings are."""
    optimisation = Optimisation(1e-3, 1e-2, 1, "constant", 1.0, batch=1, total_steps=1)
    return jax.eval_shape(optimisation.optimizer().init, params)


def epoch_order(
    key_data: Array, epoch: int | Int[Array, ""], examples: int
) -> tuple[Int[Array, "N"], PRNGKeyArray]:
    """The epoch's permutation of all examples, and the key from which its steps' keys follow."""
    epoch_key = jax.random.fold_in(jax.random.wrap_key_data(key_data), epoch)
    order_key, steps_key = jax.random.split(epoch_key)
    return jax.random.permutation(order_key, examples), steps_key


def train_step(
    policy: Any,
    opt_state: optax.OptState,
    batch: "Table",
    key: PRNGKeyArray,
    *,
    optimizer: optax.GradientTransformation,
    delays: DelayDistribution | None,
) -> tuple[Any, optax.OptState, Float[Array, ""]]:
    """One optimizer step: (policy', optimizer state', loss before the step)."""

    loss, gradient = policy.loss_and_gradient(*batch, key, delays)
    updates, opt_state = optimizer.update(gradient, opt_state, policy.params)
    params = optax.apply_updates(policy.params, updates)
    return dataclasses.replace(policy, params=params), opt_state, loss


Table = tuple[Float[Array, "N O"], Float[Array, "N H A"], Bool[Array, "N H"]]
"""Normalised observations, normalised actions, validity: the data, or one minibatch of them."""

_Carry = tuple[Any, optax.OptState, Float[Array, ""]]

_DATA_AXIS = "data"


def data_mesh(batch: int) -> Mesh | None:
    """A mesh of all local devices, or of as many as divide the batch; None where that is one."""
    devices = jax.local_devices()
    count = math.gcd(batch, len(devices))
    return Mesh(np.array(devices[:count]), (_DATA_AXIS,)) if count > 1 else None


def _on_all(mesh: Mesh | None, tree: Any) -> Any:
    """Put a copy on each device of the mesh."""
    return tree if mesh is None else jax.device_put(tree, NamedSharding(mesh, PartitionSpec()))


def _split(mesh: Mesh | None, batch: Table) -> Table:
    """Give each device its part of a minibatch."""
    if mesh is None:
        return batch
    return jax.lax.with_sharding_constraint(batch, NamedSharding(mesh, PartitionSpec(_DATA_AXIS)))


@jax.jit
def _normalised_table(policy: Any, observations: Array, actions: Array, valid: Array) -> Table:
    # Windows that reach over the end of an episode are padded; zero there is as good as anything.
    normalised = policy.normaliser.actions(PhysicalActions(actions))
    return (
        policy.normaliser.observations(observations),
        jnp.where(valid[..., None], normalised, 0.0),
        valid,
    )


@functools.partial(jax.jit, static_argnames=("optimisation", "delays", "mesh"))
def _run_segment(
    carry: _Carry,
    table: Table,
    order: Int[Array, "N"],
    steps_key: PRNGKeyArray,
    start: Int[Array, ""],
    stop: Int[Array, ""],
    *,
    optimisation: Optimisation,
    delays: DelayDistribution | None,
    mesh: Mesh | None,
) -> tuple[_Carry, Int[Array, ""], Bool[Array, ""]]:
    """Steps start..stop−1 of an epoch; ends early where the summed loss is no longer finite.

    Returns the carry (policy, optimizer state, sum of the epoch's losses), the steps done so far in
    the epoch, and whether loss and parameters are finite. The bounds are traced: one program.
    """
    optimizer = optimisation.optimizer()

    def unfinished(loop: tuple[Int[Array, ""], _Carry]) -> Bool[Array, ""]:
        step, (_, _, loss_sum) = loop
        return (step < stop) & jnp.isfinite(loss_sum)

    def advance(loop: tuple[Int[Array, ""], _Carry]) -> tuple[Int[Array, ""], _Carry]:
        step, (policy, opt_state, loss_sum) = loop
        rows = jax.lax.dynamic_slice(order, (step * optimisation.batch,), (optimisation.batch,))
        batch = _split(mesh, jax.tree.map(lambda column: column[rows], table))
        policy, opt_state, loss = train_step(
            policy,
            opt_state,
            batch,
            jax.random.fold_in(steps_key, step),
            optimizer=optimizer,
            delays=delays,
        )
        return step + 1, (policy, opt_state, loss_sum + loss)

    step, carry = jax.lax.while_loop(unfinished, advance, (start, carry))
    policy, _, loss_sum = carry
    finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(policy.params)]
    return carry, step, jnp.isfinite(loss_sum) & jnp.all(jnp.stack(finite))


@dataclass
class _Pace:
    """Chooses segment lengths by the clock and estimates the time that is left."""

    steps_left: int
    steps_per_s: float = 0.0

    def next_steps(self) -> int:
        if not self.steps_per_s:
            return _FIRST_SEGMENT_STEPS
        return max(1, round(self.steps_per_s * SEGMENT_SECONDS))

    def record(self, steps: int, seconds: float) -> None:
        self.steps_left -= steps
        latest = steps / max(seconds, 1e-9)
        # Half old, half new: follows a change of load within a few seconds without jumping.
        self.steps_per_s = (self.steps_per_s + latest) / 2 if self.steps_per_s else latest

    @property
    def seconds_left(self) -> float:
        return self.steps_left / self.steps_per_s if self.steps_per_s else float("inf")


class _Run(Generic[PolicyT]):
    """One call of `fit`: the data on the device and the compiled program, epoch by epoch."""

    def __init__(
        self,
        policy: PolicyT,
        data: Examples,
        optimisation: Optimisation,
        delays: DelayDistribution | None,
        on_progress: Callable[[Progress], None] | None,
        epochs: tuple[int, int],
        mesh: Mesh | None,
    ) -> None:
        self.policy, self.mesh = policy, mesh
        columns = map(jnp.asarray, (data.observations, data.actions, data.valid))
        self.table = _on_all(mesh, _normalised_table(policy, *columns))
        self.examples = len(data.observations)
        self.steps = steps_per_epoch(self.examples, optimisation.batch)
        self.optimisation = optimisation
        settings = {"optimisation": optimisation, "delays": delays, "mesh": mesh}
        self.advance = functools.partial(_run_segment, **settings)
        self.on_progress = on_progress
        self.first_epoch, self.stop_epoch = epochs
        self.pace = _Pace(self.steps * (self.stop_epoch - self.first_epoch))

    def warm_up(self, state: TrainState) -> None:
        """Compile by running no step, so that the speeds reported later are those of training."""
        jax.block_until_ready(self.advance(*self._epoch_inputs(state), jnp.int32(0), jnp.int32(0)))

    def epoch(self, state: TrainState) -> tuple[TrainState, EpochMetrics]:
        """Train one epoch; DivergedError if loss or parameters are no longer finite."""
        began = time.perf_counter()
        carry, *inputs = self._epoch_inputs(state)
        done, loss_sum = 0, 0.0
        while done < self.steps:
            segment_began = time.perf_counter()
            stop = min(done + self.pace.next_steps(), self.steps)
            carry, step, finite = self.advance(carry, *inputs, jnp.int32(done), jnp.int32(stop))
            if not finite:
                raise self._diverged(state.epoch, int(step))
            self.pace.record(stop - done, time.perf_counter() - segment_began)
            segment_loss = (float(carry[2]) - loss_sum) / (stop - done)
            done, loss_sum = stop, float(carry[2])
            self._show(state.epoch, done, segment_loss)
        policy, opt_state, _ = carry
        new_state = TrainState(policy.params, opt_state, state.key_data, state.epoch + 1)
        seconds = time.perf_counter() - began
        return new_state, self._metrics(new_state.epoch, loss_sum / self.steps, seconds)

    def _epoch_inputs(self, state: TrainState) -> tuple[_Carry, Table, Array, PRNGKeyArray]:
        order, steps_key = _epoch_order(state.key_data, jnp.int32(state.epoch), self.examples)
        policy: Any = dataclasses.replace(self.policy, params=state.params)  # type: ignore[type-var]
        carry = (policy, state.opt_state, jnp.float32(0.0))
        carry, order, steps_key = _on_all(self.mesh, (carry, order, steps_key))
        return carry, self.table, order, steps_key

    def _metrics(self, epoch: int, loss: float, seconds: float) -> EpochMetrics:
        samples = self.steps * self.optimisation.batch
        rate = float(self.optimisation.rate(epoch * self.steps - 1))
        return EpochMetrics(epoch, loss, rate, samples / seconds, seconds)

    def _show(self, epoch: int, done: int, loss: float) -> None:
        if self.on_progress is None:
            return
        self.on_progress(
            Progress(
                epoch=epoch + 1,
                epochs=self.stop_epoch,
                step=epoch * self.steps + done,
                steps=self.stop_epoch * self.steps,
                loss=loss,
                samples_per_s=self.pace.steps_per_s * self.optimisation.batch,
                seconds_left=self.pace.seconds_left,
            )
        )

    def _diverged(self, epoch: int, step: int) -> DivergedError:
        return DivergedError(
            f"training diverged: the loss or the parameters became NaN or infinite by step {step} "
            f"of {self.steps} in epoch {epoch + 1} "
            f"(train.learning_rate = {self.optimisation.learning_rate})",
            "lower train.learning_rate or train.grad_clip; the last checkpoint before it is kept",
        )


_epoch_order = functools.partial(jax.jit, static_argnames="examples")(epoch_order)


def fit(
    policy: PolicyT,
    data: Examples,
    config: TrainConfig,
    *,
    seed: int,
    delays: DelayDistribution | None = None,
    epochs_total: int | None = None,
    stop_epoch: int | None = None,
    state: TrainState | None = None,
    on_epoch: Callable[[TrainState, EpochMetrics], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> FitResult[PolicyT]:
    """Train from `state` (None: from the policy's parameters) until `stop_epoch` epochs are done.

    delays: the distribution of simulated delays; None is ordinary flow matching.
    epochs_total: length of the learning-rate schedule in epochs (default `config.epochs`).
    stop_epoch: default `epochs_total`. Stopping and going on from the returned state gives the
    same bits as one call.
    on_epoch: called after each epoch that ended with finite loss and parameters, with the state to
    save and its metrics; on_progress: about once a second. An exception from either, or Ctrl-C,
    ends the fit; states handed out before stay valid.

    Raises DivergedError (exit 4) where loss or parameters become NaN or infinite; no state after
    that point is handed out. UsageError for a batch or an epoch count that does not fit.
    """
    epochs_total = config.epochs if epochs_total is None else epochs_total
    stop_epoch = epochs_total if stop_epoch is None else stop_epoch
    if state is None:
        state = initial_state(policy.params, config, seed)
    _check_epochs(state, seed, stop_epoch, epochs_total)
    total_steps = epochs_total * steps_per_epoch(len(data.observations), config.batch)
    optimisation = Optimisation.from_config(config, total_steps)
    history: list[EpochMetrics] = []
    if state.epoch < stop_epoch:
        epochs, mesh = (state.epoch, stop_epoch), data_mesh(config.batch)
        run = _Run(policy, data, optimisation, delays, on_progress, epochs, mesh)
        run.warm_up(state)
        while state.epoch < stop_epoch:
            state, metrics = run.epoch(state)
            history.append(metrics)
            if on_epoch is not None:
                on_epoch(state, metrics)
    trained = dataclasses.replace(policy, params=state.params)  # type: ignore[type-var]
    return FitResult(trained, state, tuple(history))


def _check_epochs(state: TrainState, seed: int, stop_epoch: int, epochs_total: int) -> None:
    if not 0 <= state.epoch <= stop_epoch <= epochs_total:
        raise UsageError(
            f"cannot train from epoch {state.epoch} to epoch {stop_epoch} of {epochs_total}",
            "train.epochs must not be below the epochs already trained; start a new run",
        )
    expected = jax.random.fold_in(jax.random.key(seed), _TRAINING_STREAM)
    if not np.array_equal(np.asarray(state.key_data), jax.random.key_data(expected)):
        raise StateError(
            f"the state to go on from was not trained with seed {seed}",
            "use the seed of that checkpoint, or start from the beginning",
        )
