"""A policy: a velocity network, the normaliser of its data, and the configuration of both."""

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from rtc_cli.core.conditioning import Rows, Select, select_clean, select_own, select_rows
from rtc_cli.core.delays import DelayDistribution
from rtc_cli.core.flow import interpolate, masked_squares, target_velocity
from rtc_cli.core.mixer import Mixer
from rtc_cli.core.transformer import Transformer
from rtc_cli.errors import UsageError, did_you_mean

Params = dict[str, Any]
"""A plain nested dict of arrays."""

_TILE_ACTIVATIONS = 2**18
"""Activations of a network's widest layer that training keeps in a CPU's caches (1 MiB)."""


class Network(Protocol):
    """What a velocity network (an `nnx.Module`) must offer; see `Mixer` for the meanings.

    `condition` and `observe` may return any pytree; leaves of the latter have the batch first.
    `width` is the number of activations per token in the widest layer. A network with a context
    (`has_context = True`) takes what `observe` returned as a fourth argument of
    `velocity_per_token` too; profiles leave its `observe` out.
    """

    width: int

    def condition(self, times: Float[Array, " N"]) -> Any: ...

    def observe(self, observations: Float[Array, "B O"]) -> Any: ...

    def tokens(
        self, x: Float[Array, "H B A"], observed: Any, conditioning: Any, select: Select
    ) -> Float[Array, "H B A"]: ...

    def velocity_per_token(
        self, observations: Float[Array, "B O"], x: Float[Array, "B H A"], tau: Float[Array, "B H"]
    ) -> Float[Array, "B H A"]: ...


class NetworkFactory(Protocol):
    """Builds a network: `Mixer` is one."""

    def __call__(
        self,
        horizon: int,
        obs_dim: int,
        action_dim: int,
        options: Mapping[str, int],
        *,
        rngs: nnx.Rngs,
    ) -> Any: ...


_NETWORKS: dict[str, NetworkFactory] = {"mixer": Mixer, "transformer": Transformer}


def check_network(name: str, options: Mapping[str, int], horizon: int) -> None:
    """Raise UsageError if there is no such network, or not with these sizes."""
    _graph(PolicyConfig(name, tuple(options.items()), horizon, obs_dim=1, action_dim=1))


def list_networks() -> tuple[str, ...]:
    """Names of the built-in networks and of those that installed packages add."""
    plugins = entry_points(group="rtc_cli.networks").names
    return tuple(sorted(_NETWORKS.keys() | set(plugins)))


def get_network(name: str) -> NetworkFactory:
    """Return the factory of a network; UsageError for an unknown name."""
    if name in _NETWORKS:
        return _NETWORKS[name]
    for plugin in entry_points(group="rtc_cli.networks", name=name):
        return plugin.load()
    raise UsageError(f'unknown network "{name}".{did_you_mean(name, list_networks())}')


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PhysicalActions:
    """Actions (..., A) in physical units.

    A type of its own, and not an array, so that they cannot be taken for the normalised actions
    that samplers work on.
    """

    array: Float[Array, "... A"]

    def __array__(self, *args: Any, **kwargs: Any) -> np.ndarray:
        raise TypeError("PhysicalActions is not an array of normalised actions; use .array")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Normaliser:
    """Means and standard deviations of observations (O,) and of actions (A,), float32."""

    obs_mean: Float[Array, " O"]
    obs_std: Float[Array, " O"]
    action_mean: Float[Array, " A"]
    action_std: Float[Array, " A"]

    @classmethod
    def identity(cls, obs_dim: int, action_dim: int) -> "Normaliser":
        """The normaliser that changes nothing."""
        return cls(
            jnp.zeros(obs_dim), jnp.ones(obs_dim), jnp.zeros(action_dim), jnp.ones(action_dim)
        )

    @classmethod
    def from_data(
        cls,
        observations: np.ndarray,
        actions: np.ndarray | PhysicalActions,
        valid: np.ndarray | None = None,
    ) -> "Normaliser":
        """Statistics of observations (N, O) and physical actions (..., A).

        `valid` (same leading shape as actions) leaves steps out. What does not vary is divided
        by 1.
        """
        taken = np.asarray(actions.array if isinstance(actions, PhysicalActions) else actions)
        taken = taken.reshape(-1, taken.shape[-1]) if valid is None else taken[np.asarray(valid)]
        return cls(*_statistics(np.asarray(observations)), *_statistics(taken))

    def observations(self, observations: Float[Array, "... O"]) -> Float[Array, "... O"]:
        """Physical observations to normalised ones."""
        return (jnp.asarray(observations, jnp.float32) - self.obs_mean) / self.obs_std

    def actions(self, actions: PhysicalActions) -> Float[Array, "... A"]:
        """Physical actions to normalised ones; TypeError for a bare array."""
        if not isinstance(actions, PhysicalActions):
            raise TypeError(
                f"Normaliser.actions takes PhysicalActions, not {type(actions).__name__}: wrap"
                " actions in physical units as PhysicalActions(array)"
            )
        return (jnp.asarray(actions.array, jnp.float32) - self.action_mean) / self.action_std

    def physical(self, actions: Float[Array, "... A"]) -> PhysicalActions:
        """Normalised actions to physical ones; TypeError if they are physical already."""
        if isinstance(actions, PhysicalActions):
            raise TypeError("Normaliser.physical takes normalised actions, not PhysicalActions")
        return PhysicalActions(actions * self.action_std + self.action_mean)


def _statistics(rows: np.ndarray) -> tuple[Array, Array]:
    mean = rows.mean(axis=0, dtype=np.float64)
    std = rows.std(axis=0, dtype=np.float64)
    std = np.where(std > 1e-6, std, 1.0)
    return jnp.asarray(mean, jnp.float32), jnp.asarray(std, jnp.float32)


@dataclass(frozen=True)
class PolicyConfig:
    """A network's name and options and the sizes H, O and A; hashable."""

    network: str
    options: tuple[tuple[str, int], ...]
    horizon: int
    obs_dim: int
    action_dim: int


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Policy:
    """Network parameters, normaliser and configuration; a pytree (the configuration is static).

    Observations and actions of `velocity` and `loss` are normalised float32.
    """

    config: PolicyConfig = field(metadata={"static": True})
    params: Params
    normaliser: Normaliser

    @classmethod
    def init(
        cls,
        config: PolicyConfig,
        normaliser: Normaliser,
        key: PRNGKeyArray,
        *,
        adaln_zero: bool = True,
    ) -> "Policy":
        """Draw initial parameters.

        adaLN starts at zero (every block is the identity at first) unless `adaln_zero` is False:
        then its kernel is random too, as a trained one would be; for profiles and tests. Networks
        without adaLN are drawn as they are.
        """
        net_key, adaln_key = jax.random.split(key)
        params = nnx.to_pure_dict(nnx.split(_build(config, nnx.Rngs(net_key)))[1])
        if not adaln_zero and "adaln" in params:
            kernel = params["adaln"]["kernel"]
            scale = 0.5 * kernel.shape[0] ** -0.5
            params["adaln"]["kernel"] = scale * jax.random.normal(adaln_key, kernel.shape)
        return cls(config, params, normaliser)

    @property
    def network(self) -> Any:
        """The network with this policy's parameters (a `Network`)."""
        return nnx.merge(_graph(self.config), self.params)

    def time_table(self, times: np.ndarray) -> "TimeTable":
        """The network's conditioning at some flow times (N,), for `velocity` to reuse.

        A sampler's times are `sampler.times(flow_steps)`. Computed once per checkpoint, it spares
        every chunk the time embedding and the adaLN layers, most of the weights of a small batch.
        """
        conditioning = self.network.condition(jnp.asarray(times, jnp.float32))
        return TimeTable(tuple(np.asarray(times, np.float32).tolist()), conditioning)

    def observe(self, observations: Float[Array, "B O"]) -> Any:
        """What the network computes once per chunk, for `velocity` to reuse.

        For a network with a context these are its cached keys and values.
        """
        _check_shape("observations", observations, (None, self.config.obs_dim))
        return self.network.observe(jnp.asarray(observations, jnp.float32))

    def velocity(
        self,
        observations: Float[Array, "B O"],
        table: "TimeTable | None" = None,
        observed: Any = None,
    ) -> "PolicyVelocity":
        """The velocity field for normalised observations: what a sampler is called with.

        With a `table` of the sampler's times, its conditioning is not computed again; with
        `observed`, what `observe` returned for these observations, neither is that.
        """
        _check_shape("observations", observations, (None, self.config.obs_dim))
        observations = jnp.asarray(observations, jnp.float32)
        return PolicyVelocity(self.config, self.params, observations, table, observed)

    def loss(
        self,
        observations: Float[Array, "B O"],
        actions: Float[Array, "B H A"],
        valid: Bool[Array, "B H"],
        key: PRNGKeyArray,
        delays: DelayDistribution | None = None,
    ) -> Float[Array, ""]:
        """Flow-matching loss with simulated delay (arXiv 2512.05964, Algorithm 1).

        Per example tau ~ U[0, 1] and d ~ `delays`; tokens i < d have flow time 1, so they enter
        clean, and do not count. Squared errors of valid postfix elements are averaged over the
        batch (0 if there are none). `delays` None is ordinary flow matching; with constant delay
        0 the loss is the same.
        """
        return self.loss_at(observations, actions, valid, *_draw(key, actions, delays))

    def loss_and_gradient(
        self,
        observations: Float[Array, "B O"],
        actions: Float[Array, "B H A"],
        valid: Bool[Array, "B H"],
        key: PRNGKeyArray,
        delays: DelayDistribution | None = None,
    ) -> tuple[Float[Array, ""], Params]:
        """`loss` and its gradient by the parameters.

        On a CPU a large batch passes through forward and backward in tiles that fit its caches,
        their gradients summed: the same numbers up to rounding, and faster.
        """
        examples = (observations, actions, valid, *_draw(key, actions, delays))
        batch = len(observations)
        tile = self._training_tile(batch)
        parts = jax.tree.map(lambda x: x.reshape(batch // tile, tile, *x.shape[1:]), examples)

        def squares(params: Params, part: Any) -> tuple[Array, Array]:
            return dataclasses.replace(self, params=params)._squares_at(*part)

        def add(sums: Any, part: Any) -> tuple[Any, None]:
            found = jax.value_and_grad(squares, has_aux=True)(self.params, part)
            return jax.tree.map(jnp.add, sums, found), None

        nothing = ((jnp.zeros(()), jnp.zeros(())), jax.tree.map(jnp.zeros_like, self.params))
        if tile == batch:
            sums, _ = add(nothing, examples)
        else:
            sums, _ = jax.lax.scan(add, nothing, parts)
        (total, elements), gradient = sums
        share = 1.0 / jnp.maximum(elements, 1.0)
        return total * share, jax.tree.map(lambda g: g * share, gradient)

    def _training_tile(self, batch: int) -> int:
        """The largest divisor of the batch whose activations fit; the batch if none is near."""
        if jax.default_backend() != "cpu":
            return batch
        fits = max(1, _TILE_ACTIVATIONS // (self.config.horizon * self.network.width))
        tile = max(n for n in range(1, min(fits, batch) + 1) if batch % n == 0)
        return tile if 2 * tile >= fits else batch

    def loss_at(
        self,
        observations: Float[Array, "B O"],
        actions: Float[Array, "B H A"],
        valid: Bool[Array, "B H"],
        noise: Float[Array, "B H A"],
        tau: Float[Array, " B"],
        delay: Array | None,
    ) -> Float[Array, ""]:
        """The loss for given noise, flow times (B,) and delays (B,) int32: no randomness."""
        total, elements = self._squares_at(observations, actions, valid, noise, tau, delay)
        return total / jnp.maximum(elements, 1.0)

    def _squares_at(
        self,
        observations: Float[Array, "B O"],
        actions: Float[Array, "B H A"],
        valid: Bool[Array, "B H"],
        noise: Float[Array, "B H A"],
        tau: Float[Array, " B"],
        delay: Array | None,
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Sum of squared errors of the elements that count, and their number."""
        config = self.config
        _check_shape("observations", observations, (None, config.obs_dim))
        _check_shape("actions", actions, (None, config.horizon, config.action_dim))
        data, noise = jnp.swapaxes(actions, 0, 1), jnp.swapaxes(noise, 0, 1)
        counted = jnp.swapaxes(valid, 0, 1)
        token_tau = tau[None]
        times = tau
        select: Select = select_own
        if delay is not None:
            prefix = jnp.arange(config.horizon)[:, None] < delay
            counted = counted & ~prefix
            token_tau = jnp.where(prefix, 1.0, token_tau)
            times, select = jnp.append(tau, 1.0), select_clean(prefix)
        x = interpolate(data, noise, token_tau[..., None])
        network = self.network
        v = network.tokens(x, network.observe(observations), network.condition(times), select)
        return masked_squares(v - target_velocity(data, noise), counted)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TimeTable:
    """A network's conditioning at known flow times; row i belongs to times[i]."""

    times: tuple[float, ...] = field(metadata={"static": True})
    conditioning: Any


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PolicyVelocity:
    """A policy's velocity field for a batch of observations.

    Called with any flow times (B, H) it takes the straightforward path, per token. Samplers use
    `tabulate` instead, which computes once what depends on flow time or observation only.
    """

    config: PolicyConfig = field(metadata={"static": True})
    params: Params
    observations: Float[Array, "B O"]
    table: TimeTable | None = None
    observed: Any = None

    def __call__(self, x: Float[Array, "B H A"], tau: Float[Array, "B H"]) -> Float[Array, "B H A"]:
        network = nnx.merge(_graph(self.config), self.params)
        cached = () if self.observed is None else (self.observed,)
        return network.velocity_per_token(self.observations, x, tau, *cached)

    def tabulate(self, times: np.ndarray) -> "TableVelocity":
        """The same field for tokens whose flow times are rows of a table of times (N,)."""
        network = nnx.merge(_graph(self.config), self.params)
        observed = self.observed
        if observed is None:
            observed = network.observe(self.observations)
        if self.table is None or self.table.times != tuple(np.asarray(times, np.float32).tolist()):
            conditioning = network.condition(jnp.asarray(times, jnp.float32))
        else:
            conditioning = self.table.conditioning
        return TableVelocity(self.config, self.params, conditioning, observed)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TableVelocity:
    """A velocity field on a table of flow times, token-major.

    `conditioning` belongs to the table's rows; leaves of `observed` have the batch first, so a
    part of the batch is a part of them.
    """

    config: PolicyConfig = field(metadata={"static": True})
    params: Params
    conditioning: Any
    observed: Any

    def __call__(self, x: Float[Array, "H B A"], rows: Rows) -> Float[Array, "H B A"]:
        """Velocity of x where the tokens have the flow times of these rows of the table."""
        network = nnx.merge(_graph(self.config), self.params)
        return network.tokens(x, self.observed, self.conditioning, select_rows(rows))

    def part(self, observed: Any) -> "TableVelocity":
        """The same field for other examples."""
        return dataclasses.replace(self, observed=observed)


def _draw(
    key: PRNGKeyArray, actions: Float[Array, "B H A"], delays: DelayDistribution | None
) -> tuple[Float[Array, "B H A"], Float[Array, " B"], Array | None]:
    """Noise, flow times and delays of a training batch."""
    noise_key, tau_key, delay_key = jax.random.split(key, 3)
    noise = jax.random.normal(noise_key, actions.shape)
    tau = jax.random.uniform(tau_key, actions.shape[:1])
    return noise, tau, None if delays is None else delays.sample(delay_key, tau.shape)


def _build(config: PolicyConfig, rngs: nnx.Rngs) -> Any:
    return get_network(config.network)(
        config.horizon, config.obs_dim, config.action_dim, dict(config.options), rngs=rngs
    )


def parameter_shapes(config: PolicyConfig) -> Any:
    """Shapes and dtypes of a network's parameters, nested as `Params`; nothing is allocated."""
    return nnx.to_pure_dict(_abstract(config)[1])


def _graph(config: PolicyConfig) -> Any:
    return _abstract(config)[0]


@functools.lru_cache(maxsize=64)
def _abstract(config: PolicyConfig) -> Any:
    """Graph and state of a network, by its shapes alone."""
    return nnx.split(nnx.eval_shape(lambda: _build(config, nnx.Rngs(0))))


def _check_shape(name: str, array: Any, expected: tuple[int | None, ...]) -> None:
    shape = np.shape(array)
    fits = len(shape) == len(expected) and all(
        e is None or e == n for n, e in zip(shape, expected, strict=True)
    )
    if not fits:
        wanted = ", ".join("B" if e is None else str(e) for e in expected)
        raise UsageError(f"{name} has shape {shape}, this policy needs ({wanted})")
