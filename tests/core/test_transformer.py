"""The transformer against itself written out plainly, and against what a context must not do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_weights import random_policy

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig
from rtc_cli.errors import UsageError
from rtc_cli.samplers import ChunkRequest, get_sampler

H, OBS, A, B = 6, 5, 3, 4
SIZES = {
    "layers": 2,
    "channels": 16,
    "channel_hidden": 24,
    "heads": 4,
    "kv_heads": 2,
    "head_dim": 8,
    "context": 3,
}


def make(**changes: int) -> Policy:
    options = tuple((SIZES | changes).items())
    return random_policy(PolicyConfig("transformer", options, H, OBS, A))


@pytest.fixture(scope="module")
def policy() -> Policy:
    return make()


@pytest.fixture(scope="module")
def inputs() -> tuple[jax.Array, jax.Array, jax.Array]:
    generator = np.random.default_rng(1)
    observations, x = generator.standard_normal((B, OBS)), generator.standard_normal((B, H, A))
    tau = generator.random((B, H))
    return tuple(jnp.asarray(part, jnp.float32) for part in (observations, x, tau))


@jax.jit
def velocity(policy: Policy, observations: jax.Array, x: jax.Array, tau: jax.Array) -> jax.Array:
    return policy.velocity(observations)(x, tau)


def written_out(policy: Policy, observation: np.ndarray, x: np.ndarray, tau: np.ndarray):
    """The velocity of one example in float64: a loop over tokens and heads, nothing shared."""
    p = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), policy.params)
    sizes = dict(policy.config.options)
    D, heads, groups = sizes["head_dim"], sizes["heads"], sizes["kv_heads"]

    def norm(v):
        return (v - v.mean()) / np.sqrt(v.var() + 1e-6)

    def gelu(v):
        return 0.5 * v * (1 + np.tanh(np.sqrt(2 / np.pi) * (v + 0.044715 * v**3)))

    def swish(v):
        return v / (1 + np.exp(-v))

    def vectors(t):
        width = sizes["channels"]
        period = 4e-3 * 1000.0 ** np.linspace(0, 1, width // 2)
        e = np.concatenate([np.sin(2 * np.pi * t / period), np.cos(2 * np.pi * t / period)])
        for layer in ("first", "second"):
            e = swish(e @ p["time"][layer]["kernel"] + p["time"][layer]["bias"])
        return np.split(e @ p["adaln"]["kernel"] + p["adaln"]["bias"], 6 * sizes["layers"] + 2)

    def split(key_value):
        keys, values = np.split(key_value, 2)
        return keys.reshape(groups, D), values.reshape(groups, D)

    context = []
    for position in p["context_position"]:
        c = observation @ p["context_in"] + position
        c = c + gelu(norm(c) @ p["context_hidden"]) @ p["context_out"]
        context.append(norm(c))
    modulation = [vectors(t) for t in tau]
    h = [a @ p["input"] + position for a, position in zip(x, p["position"], strict=True)]
    for index in range(sizes["layers"]):
        block = p[f"block_{index}"]
        m = [v[6 * index : 6 * index + 6] for v in modulation]
        seen = [norm(t) * (1 + v[0]) + v[1] for t, v in zip(h, m, strict=True)]
        memory = [split(c @ block["context_key_value"]) for c in context]
        memory += [split(t @ block["key_value"]) for t in seen]
        for i in range(len(h)):
            query = (seen[i] @ block["query"]).reshape(heads, D)
            out = []
            for head in range(heads):
                group = head // (heads // groups)
                score = np.array([query[head] @ keys[group] for keys, _ in memory]) / np.sqrt(D)
                weight = np.exp(score - score.max())
                weight /= weight.sum()
                out.append(sum(w * v[group] for w, (_, v) in zip(weight, memory, strict=True)))
            h[i] = h[i] + m[i][2] * (np.concatenate(out) @ block["attended"])
            gate, value = np.split((norm(h[i]) * (1 + m[i][3]) + m[i][4]) @ block["mlp_in"], 2)
            h[i] = h[i] + m[i][5] * ((gelu(gate) * value) @ block["mlp_out"])
    last = [norm(t) * (1 + v[-2]) + v[-1] for t, v in zip(h, modulation, strict=True)]
    return np.stack(last) @ p["output"]["kernel"] + p["output"]["bias"]


def test_velocity_is_the_written_out_network(policy, inputs):
    observations, x, tau = inputs
    found = velocity(policy, observations, x, tau)
    for b in range(B):
        expected = written_out(policy, *(np.asarray(part[b], np.float64) for part in inputs))
        np.testing.assert_allclose(found[b], expected, atol=2e-5)


def test_the_table_gives_the_same_velocity(policy, inputs):
    observations, x, _ = inputs
    times = np.array([0.0, 0.2, 1.0])
    rows = jnp.asarray(np.random.default_rng(0).integers(0, 3, (H, B)))
    field = jax.jit(lambda policy, x, rows: policy.velocity(observations).tabulate(times)(x, rows))
    fast = field(policy, jnp.swapaxes(x, 0, 1), rows)
    plain = velocity(policy, observations, x, jnp.asarray(times, jnp.float32)[rows].T)
    np.testing.assert_allclose(jnp.swapaxes(fast, 0, 1), plain, atol=2e-5)


@pytest.mark.parametrize("sampler", ["plain", "pinv", "prefix"])
def test_a_cached_context_changes_no_chunk(policy, inputs, sampler):
    observations, noise, _ = inputs
    overlap = np.random.default_rng(5).standard_normal(noise.shape, np.float32)
    request = ChunkRequest(ChunkGeometry(H, 2, 2), 4, noise, overlap)
    sample = jax.jit(get_sampler(sampler))
    cached = policy.velocity(observations, observed=policy.observe(observations))
    own = policy.velocity(observations)
    np.testing.assert_allclose(sample(cached, request), sample(own, request), atol=1e-6)
    other = policy.velocity(jnp.zeros_like(observations), observed=policy.observe(observations))
    np.testing.assert_array_equal(sample(other, request), sample(cached, request))


def test_the_context_and_every_token_matter(policy, inputs):
    observations, x, tau = inputs
    base = velocity(policy, observations, x, tau)
    assert jnp.abs(velocity(policy, observations + 1.0, x, tau) - base).max() > 1e-3
    moved = velocity(policy, observations, x.at[:, -1].add(1.0), tau)
    assert jnp.abs(moved - base)[:, 0].max() > 1e-4  # attention is not causal


def test_bfloat16_is_near_float32(policy, inputs):
    observations, x, tau = inputs
    half = make(bfloat16=1)
    params = jax.tree.map(lambda a, b: jnp.asarray(a, b.dtype), policy.params, half.params)
    rounded = Policy(half.config, params, policy.normaliser)
    assert any(leaf.dtype == jnp.bfloat16 for leaf in jax.tree.leaves(params))
    exact, found = velocity(policy, observations, x, tau), velocity(rounded, observations, x, tau)
    assert found.dtype == jnp.float32
    error = jnp.linalg.norm(found - exact) / jnp.linalg.norm(exact)
    assert 1e-5 < error < 0.05


def test_adaln_zero_starts_as_the_output_layer_of_the_input(inputs):
    config = PolicyConfig("transformer", tuple((SIZES | {"layers": 1}).items()), H, OBS, A)
    fresh = Policy.init(config, Normaliser.identity(OBS, A), jax.random.key(0))
    observations, x, tau = inputs
    first = velocity(fresh, observations, x, tau)
    # All gates are 0: neither the observation, nor flow time, nor another token has a say.
    np.testing.assert_array_equal(velocity(fresh, observations + 1.0, x, tau), first)
    np.testing.assert_array_equal(velocity(fresh, observations, x, 1 - tau), first)


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("heads", 3, "kv_heads = 2"),
        ("channels", 15, "even"),
        ("bfloat16", 2, "0 or 1"),
        ("token_hidden", 3, "unknown transformer option"),
        ("context", 0, ">= 1"),
    ],
)
def test_refused_sizes(option, value, said):
    with pytest.raises(UsageError) as caught:
        make(**{option: value})
    assert said in f"{caught.value} {caught.value.hint}"
