"""What a chunk must read: counted by hand on small functions and on a transformer's weights."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_weights import random_policy

from rtc_cli.analysis import floor, networks
from rtc_cli.analysis.floor import Ceilings, Needs, bytes_read
from rtc_cli.analysis.networks import PRESETS, check_memory, preset_config
from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.policy import Policy, PolicyConfig, parameter_shapes
from rtc_cli.errors import UsageError
from rtc_cli.samplers import ChunkRequest, get_sampler

WEIGHT = jnp.ones((256, 256))
BYTES = WEIGHT.size * 4


@pytest.fixture(autouse=True)
def everything_counts(monkeypatch):
    monkeypatch.setattr(floor, "_CACHES", 0)


def test_an_input_counts_once_for_every_product():
    x = jnp.ones(256)
    assert bytes_read(lambda w, x: w @ x, WEIGHT, x) == BYTES
    assert bytes_read(lambda w, x: w @ (w @ x), WEIGHT, x) == 2 * BYTES
    assert bytes_read(lambda w, x: 2 * x, WEIGHT, x) == 0
    loop = jax.jit(lambda w, x: jax.lax.fori_loop(0, 7, lambda _, x: w @ x, x))
    assert bytes_read(loop, WEIGHT, x) == 7 * BYTES


def test_a_backward_pass_reads_the_weights_again():
    def pulled(w, x):
        y, pull = jax.vjp(lambda x: jnp.tanh(w @ x), x)
        return pull(y)[0]

    assert bytes_read(pulled, WEIGHT, jnp.ones(256)) == 2 * BYTES


def test_what_fits_the_caches_is_not_read_from_memory(monkeypatch):
    monkeypatch.setattr(floor, "_CACHES", BYTES + 1)
    assert bytes_read(lambda w, x: w @ x, WEIGHT, jnp.ones(256)) == 0


@pytest.fixture(scope="module")
def transformer() -> Policy:
    sizes = {"layers": 1, "channels": 128, "channel_hidden": 256, "heads": 2, "kv_heads": 1}
    options = tuple((sizes | {"head_dim": 128, "context": 200}).items())
    return random_policy(PolicyConfig("transformer", options, 8, 5, 3))


@pytest.mark.parametrize(("sampler", "passes"), [("plain", 1), ("prefix", 1), ("pinv", 2)])
def test_a_step_reads_every_weight_of_the_blocks_once_per_pass(transformer, sampler, passes):
    policy, steps = transformer, 3
    blocks = [policy.params[f"block_{i}"] for i in range(1)]
    weights = sum(w.nbytes for b in blocks for name, w in b.items() if "context" not in name)
    observations, noise = jnp.ones((1, 5)), jnp.ones((1, 8, 3))
    # Reads are counted on the program, so shapes will do.
    observed = jax.eval_shape(policy.observe, observations)
    cached = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(observed))
    sample = get_sampler(sampler)
    table = jax.eval_shape(lambda policy: policy.time_table(sample.times(steps)), policy)

    def chunk(policy, table, observations, observed, noise):
        request = ChunkRequest(ChunkGeometry(8, jnp.int32(4), jnp.int32(2)), steps, noise, noise)
        return sample(policy.velocity(observations, table, observed), request)

    found = bytes_read(chunk, policy, table, observations, observed, noise)
    assert found == steps * passes * (weights + cached)


def test_the_floor_is_the_larger_of_the_two():
    ceilings = Ceilings(bytes_per_s=1e9, flops_per_s=1e12, dtype="float32")
    assert Needs(bytes=10**6, flops=1e6).floor_ms(ceilings) == pytest.approx(1.0)
    assert Needs(bytes=10**6, flops=3e9).floor_ms(ceilings) == pytest.approx(3.0)
    assert Needs(bytes=10**6, flops=None).floor_ms(ceilings) == pytest.approx(1.0)


@pytest.mark.parametrize(("name", "millions"), [("expert-300m", 311), ("expert-860m", 869)])
def test_experts_have_as_many_parameters_as_their_names_say(name, millions):
    """Without adaLN, time embedding and the stand-in for the vision-language model."""
    shapes = parameter_shapes(preset_config(name))
    blocks = [value for key, value in shapes.items() if key.startswith("block_")]
    count = sum(
        int(np.prod(leaf.shape)) for b in blocks for key, leaf in b.items() if "context" not in key
    )
    assert count / 1e6 == pytest.approx(millions, abs=1)


def test_bfloat16_halves_the_parameters():
    sizes = [
        sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(parameter_shapes(config)))
        for config in (preset_config("expert-300m"), preset_config("expert-300m", dtype="bfloat16"))
    ]
    assert sizes[1] / sizes[0] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("expert-300",), 'mean "expert-300m"'),
        (("paper", None, "float16"), "float16"),
        (("paper", None, "bfloat16"), "no bfloat16"),
    ],
)
def test_unknown_networks_and_dtypes(arguments, said):
    with pytest.raises(UsageError) as caught:
        preset_config(*arguments)
    assert said in str(caught.value)


def test_a_network_that_does_not_fit_is_refused_before_it_is_made(monkeypatch):
    monkeypatch.setattr("rtc_cli.analysis.networks.free_memory", lambda: 10**9)
    with pytest.raises(UsageError, match=r"needs 3\.\d GB, 1\.0 GB are free"):
        check_memory(preset_config("expert-300m"), "expert-300m")
    assert set(PRESETS) >= {"quickstart", "paper", "expert-300m", "expert-860m"}


def test_the_limit_of_a_container_counts(tmp_path):
    assert networks._container_room(tmp_path) is None
    (tmp_path / "memory.current").write_text("3000\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert networks._container_room(tmp_path) is None
    (tmp_path / "memory.max").write_text("5000\n")
    assert networks._container_room(tmp_path) == 2000
    old = tmp_path / "old"
    old.mkdir()
    (old / "memory.limit_in_bytes").write_text("7000\n")
    (old / "memory.usage_in_bytes").write_text("1000\n")
    assert networks._container_room(old) == 6000


def test_free_memory_is_no_more_than_the_machine_has():
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert 0 < networks.free_memory() <= pages
