"""What guidance does, step by step: for "it has hardly any effect" and for "it jerks".

Before each Euler step the sampler's chunk x at flow time tau stands for the action chunk
x1 = x + (1 - tau) v(x, tau), the denoised estimate. Guidance is to bring its first d tokens onto
the committed actions Y. So the distance of x1 from Y on the prefix, before and after a step, says
what a step achieved; the guidance weight, and whether it was clipped, says why; and the jump from
the last committed action to the first new one is what the robot feels.

Normalised actions throughout.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtc_cli.core.geometry import ChunkGeometry
from rtc_cli.core.guidance import guidance_weight
from rtc_cli.core.policy import Policy
from rtc_cli.errors import UsageError
from rtc_cli.samplers import ChunkRequest, Sampler, get_sampler
from rtc_cli.samplers.pinv import Guided


@dataclass(frozen=True)
class Seam:
    """A real hand-over: observations (B, O) normalised, overlap (B, H, A), geometry."""

    observations: Float[Array, "B O"]
    overlap: Float[Array, "B H A"]
    geometry: ChunkGeometry


def recorded_seams(
    policy: Policy,
    observations: np.ndarray,
    lengths: np.ndarray,
    geometry: ChunkGeometry,
    *,
    count: int = 64,
    flow_steps: int = 5,
    seed: int = 0,
) -> Seam:
    """Hand-overs at recorded observations: the running chunk starts s control steps before.

    `observations` (N, O) are physical, of episodes of `lengths` (E,) one after another. `count`
    pairs (t, t + s) within an episode are drawn; the running chunk is what `plain` gives at t, and
    its rest from index s on is the overlap at t + s. UsageError if no episode is longer than s.
    """
    s = geometry.exec_horizon
    rows = np.concatenate(
        [
            np.arange(start, start + length - s)
            for start, length in zip(np.cumsum(lengths) - lengths, lengths, strict=True)
        ]
        or [np.empty(0, int)]
    )
    if not len(rows):
        raise UsageError(f"no episode is longer than s = {s}", "use a smaller s")
    generator = np.random.Generator(np.random.Philox(seed))
    picked = rows[generator.integers(0, len(rows), count)]
    before, now = (
        policy.normaliser.observations(jnp.asarray(observations[at])) for at in (picked, picked + s)
    )
    noise = _noise(policy, count, seed)
    running = get_sampler("plain")(
        policy.velocity(before),
        ChunkRequest(ChunkGeometry(geometry.horizon, s, 0), flow_steps, noise),
    )
    rest = jnp.concatenate([running[:, s:], jnp.zeros_like(running[:, :s])], axis=1)
    return Seam(now, rest, geometry)


def explain(
    policy: Policy,
    seam: Seam,
    samplers: Sequence[tuple[str, Sampler]],
    *,
    flow_steps: int = 5,
    seed: int = 0,
) -> dict[str, Any]:
    """Follow each named sampler through its steps; `steps` has a row per sampler and step.

    Row keys: sampler, step, tau, weight_unclipped, weight, clipped (null without guidance),
    prefix_error_before, prefix_error_after (root mean square over examples, prefix tokens and
    dimensions). `seams` has a row per sampler: jump (from the last committed action to the first
    new one, mean norm over examples), gap (new chunk against overlap at index d, where there is
    one), and usual_jump (mean norm from action to action within the running chunks).
    """
    if seam.geometry.delay == 0:
        raise UsageError("delay 0 has no prefix to look at", "use a delay of at least 1")
    noise = _noise(policy, len(seam.overlap), seed + 1)
    request = ChunkRequest(seam.geometry, flow_steps, noise, seam.overlap)
    steps: list[dict[str, Any]] = []
    seams = []
    for name, sampler in samplers:
        path = jax.jit(lambda p, r, sampler=sampler: _estimates(p, seam.observations, sampler, r))
        estimates = np.asarray(path(policy, request))
        steps += _step_rows(name, sampler, estimates, np.asarray(seam.overlap), seam.geometry)
        seams.append({"sampler": name} | _seam(estimates[-1], np.asarray(seam.overlap), seam))
    return {"steps": steps, "seams": seams}


def _estimates(
    policy: Policy, observations: Array, sampler: Sampler, request: ChunkRequest
) -> Float[Array, "K+1 B H A"]:
    """The denoised estimate before each step; the chunk itself at the end."""
    velocity = policy.velocity(observations)
    path = sampler.path(velocity, request)
    count = request.flow_steps
    clean = jnp.arange(request.geometry.horizon) < request.geometry.delay
    is_prefix = len(sampler.times(count)) > count  # its committed tokens have flow time 1

    def estimate(step: tuple[Array, Array]) -> Array:
        x, flow_time = step
        tau = jnp.broadcast_to(flow_time, x.shape[:2])
        tau = jnp.where(clean[None] & is_prefix, 1.0, tau)
        return x + (1 - tau)[..., None] * velocity(x, tau)

    estimates = jax.lax.map(estimate, (path[:-1], jnp.arange(count) / count))
    return jnp.concatenate([estimates, path[-1:]])


def _step_rows(
    name: str, sampler: Sampler, estimates: np.ndarray, overlap: np.ndarray, geometry: ChunkGeometry
) -> list[dict[str, Any]]:
    count, d = len(estimates) - 1, int(geometry.delay)
    errors = np.sqrt(np.mean((estimates[:, :, :d] - overlap[None, :, :d]) ** 2, axis=(1, 2, 3)))
    rows = []
    for index in range(count):
        rows.append(
            {
                "sampler": name,
                "step": index,
                "tau": index / count,
                **_weights(sampler, index / count),
                "prefix_error_before": float(errors[index]),
                "prefix_error_after": float(errors[index + 1]),
            }
        )
    return rows


def _weights(sampler: Sampler, tau: float) -> dict[str, Any]:
    if not isinstance(sampler, Guided):
        return {"weight_unclipped": None, "weight": None, "clipped": None}
    free = float(guidance_weight(jnp.float32(tau), np.inf, sampler.prior_std))
    used = float(guidance_weight(jnp.float32(tau), sampler.max_guidance_weight, sampler.prior_std))
    return {
        "weight_unclipped": free if np.isfinite(free) else None,
        "weight": used,
        "clipped": used < free,
    }


def _seam(chunk: np.ndarray, overlap: np.ndarray, seam: Seam) -> dict[str, float | None]:
    geometry = seam.geometry
    d, known = int(geometry.delay), int(geometry.overlap)
    within = np.linalg.norm(np.diff(overlap[:, :known], axis=1), axis=-1)
    gap = np.linalg.norm(chunk[:, d] - overlap[:, d], axis=-1).mean() if d < known else None
    return {
        "jump": float(np.linalg.norm(chunk[:, d] - overlap[:, d - 1], axis=-1).mean()),
        "gap": None if gap is None else float(gap),
        "usual_jump": float(within.mean()) if within.size else None,
    }


def _noise(policy: Policy, count: int, seed: int) -> Float[Array, "B H A"]:
    shape = (count, policy.config.horizon, policy.config.action_dim)
    return jax.random.normal(jax.random.key(seed), shape)


def findings(explanation: dict[str, Any]) -> list[str]:
    """What the figures say, a sentence per sampler."""
    found = []
    for seam in explanation["seams"]:
        name = seam["sampler"]
        rows = [row for row in explanation["steps"] if row["sampler"] == name]
        first, last = rows[0]["prefix_error_before"], rows[-1]["prefix_error_after"]
        clipped = sum(bool(row["clipped"]) for row in rows)
        weights = (
            f", its weight clipped in {clipped} of {len(rows)} steps" if rows[0]["weight"] else ""
        )
        usual = seam["usual_jump"]
        times = f", {seam['jump'] / usual:.1f} times the usual one" if usual else ""
        found.append(
            f"{name}: prefix error {first:.2g} at the start, {last:.2g} at the end{weights}; "
            f"jump at the seam {seam['jump']:.2g}{times}."
        )
    return found
