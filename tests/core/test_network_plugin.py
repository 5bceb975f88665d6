"""The network of docs/adding-a-network.md, installed as a package would install it."""

import dataclasses
import re
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtc_cli.analysis.profile import profile_samplers
from rtc_cli.core import policy as policies
from rtc_cli.core.policy import Normaliser, Policy, PolicyConfig, get_network, list_networks
from rtc_cli.pipeline.checks import check_recipe
from rtc_cli.recipe import load_recipe

PAGE = Path(__file__).parents[2] / "docs" / "adding-a-network.md"
B, H, A, OBS = 3, 8, 2, 5


@pytest.fixture(autouse=True)
def _installed(tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), flags=re.S)
    (tmp_path / "my_package.py").write_text(code, "utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    (name, target) = re.findall(r"^(\w+) = \"(my_package:\w+)\"$", PAGE.read_text("utf-8"), re.M)[0]
    entry = EntryPoints([EntryPoint(name, target, "rtc_cli.networks")])
    monkeypatch.setattr(policies, "entry_points", entry.select)
    policies._abstract.cache_clear()


@pytest.fixture
def policy():
    config = PolicyConfig("pooled", (("channels", 16),), H, OBS, A)
    return Policy.init(config, Normaliser.identity(OBS, A), jax.random.key(0))


def test_it_is_known_by_name():
    assert list_networks() == ("mixer", "pooled", "transformer")
    assert get_network("pooled").__name__ == "Pooled"
    check_recipe(load_recipe("quickstart", ["network.kind=pooled"]))


def test_both_paths_are_the_same_function(policy):
    x, obs = (jax.random.normal(jax.random.key(i), s) for i, s in ((1, (B, H, A)), (2, (B, OBS))))
    times = np.linspace(0, 1, 5)
    rows = jax.random.randint(jax.random.key(3), (H, B), 0, 5)
    table = policy.velocity(obs).tabulate(times)(jnp.swapaxes(x, 0, 1), rows)
    direct = policy.velocity(obs)(x, jnp.asarray(times, jnp.float32)[rows.T])
    np.testing.assert_allclose(jnp.swapaxes(table, 0, 1), direct, atol=1e-5)
    assert float(jnp.abs(direct).max()) > 0.01


def test_it_is_profiled_with_every_sampler(policy):
    rows = profile_samplers("pooled", ["pinv", "prefix"], rounds=2, flow_steps=(2,))
    assert [row["sampler"] for row in rows] == ["plain", "pinv", "prefix", "prefix-per-token"]
    assert all(row["network"] == "pooled" and row["p50_ms"] > 0 for row in rows)


def test_its_loss_falls_with_its_gradient(policy):
    obs = jax.random.normal(jax.random.key(4), (64, OBS))
    actions = jnp.broadcast_to(obs[:, None, :A], (64, H, A))
    valid, key = jnp.ones((64, H), bool), jax.random.key(5)

    before, slope = jax.jit(Policy.loss_and_gradient)(policy, obs, actions, valid, key)
    stepped = jax.tree.map(lambda value, by: value - 0.1 * by, policy.params, slope)
    after = jax.jit(Policy.loss)(
        dataclasses.replace(policy, params=stepped), obs, actions, valid, key
    )
    assert after < before
