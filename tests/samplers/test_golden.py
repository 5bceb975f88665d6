"""Golden values: chunks that the public RTC reference code computed (see tests/data/README.md)."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.samplers import ChunkRequest, get_sampler

FILE = Path(__file__).parents[1] / "data" / "reference_samplers.npz"


def analytic_velocity(case):
    w1, b1, u, w2, obs = (jnp.asarray(case[k], jnp.float32) for k in ("W1", "b1", "u", "W2", "obs"))

    def velocity(x, tau):
        h = jnp.tanh(x.reshape(x.shape[0], -1) @ w1 + b1 + obs + tau[:, :1] * u)
        return (h @ w2).reshape(x.shape) - 0.5 * x

    return velocity


@pytest.mark.parametrize("number", range(4))
@pytest.mark.parametrize("sampler", ["plain", "pinv"])
def test_reproduces_the_reference(number, sampler):
    with np.load(FILE) as arrays:
        case = {k.split("/")[1]: v for k, v in arrays.items() if k.startswith(f"case{number}/")}
    meta = json.loads(str(case["meta"]))
    settings = (
        {"mask": meta["schedule"], "max_guidance_weight": float(meta["beta"])}
        if sampler == "pinv"
        else {}
    )
    request = ChunkRequest(
        geometry=ChunkGeometry(meta["H"], meta["s"], meta["d"]),
        flow_steps=meta["K"],
        noise=case["noise"],
        overlap=case["overlap"],
    )
    chunk = get_sampler(sampler, **settings)(analytic_velocity(case), request)
    expected = case["guided" if sampler == "pinv" else "plain"]
    np.testing.assert_allclose(chunk, expected, atol=1e-5)
