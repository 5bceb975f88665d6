"""The loop against a hand-written one, its schedule and order, resume and divergence."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from rtc_cli.core.delays import DelayDistribution
from rtc_cli.errors import DivergedError, StateError, UsageError
from rtc_cli.training import loop
from rtc_cli.training.loop import Optimisation, epoch_order, fit, fork_epoch, initial_state


def rate_by_hand(config, total_steps, n):
    rate = config.learning_rate * min(1.0, (n + 1) / config.warmup_steps)
    if config.decay == "linear_last_quarter" and n > 0.75 * total_steps:
        rate *= (total_steps - n) / (0.25 * total_steps)
    return rate


@pytest.mark.parametrize("decay", ["constant", "linear_last_quarter"])
def test_fit_equals_a_loop_written_by_hand(line, windows, config, decay):
    config = config.model_copy(update={"decay": decay, "grad_clip": 0.2})
    state = initial_state(line.params, config, seed=9)
    params, steps = line.params, len(windows.observations) // config.batch
    total = config.epochs * steps
    optimizer = optax.inject_hyperparams(optax.adamw)(0.0, weight_decay=config.weight_decay)
    opt_state = optimizer.init(params)
    for n in range(total):
        epoch, step = divmod(n, steps)
        order, steps_key = epoch_order(state.key_data, epoch, len(windows.observations))
        rows = np.asarray(order)[step * config.batch : (step + 1) * config.batch]
        batch = (windows.observations[rows], windows.actions[rows], windows.valid[rows])
        key = jax.random.fold_in(steps_key, step)
        gradient = jax.grad(lambda p, b, k: dataclasses.replace(line, params=p).loss(*b, k, None))(
            params, batch, key
        )
        norm = np.sqrt(sum(float(jnp.sum(g**2)) for g in gradient.values()))
        gradient = {k: g * min(1.0, config.grad_clip / norm) for k, g in gradient.items()}
        opt_state.hyperparams["learning_rate"] = rate_by_hand(config, total, n)
        updates, opt_state = optimizer.update(gradient, opt_state, params)
        params = optax.apply_updates(params, updates)
    trained = fit(line, windows, config, seed=9).state.params
    for name, value in params.items():
        np.testing.assert_allclose(trained[name], value, rtol=2e-5, atol=2e-6)


def test_schedule_warms_up_stays_and_falls_to_almost_zero(config):
    config = config.model_copy(update={"warmup_steps": 10})
    optimisation = Optimisation.from_config(config, total_steps=400)
    rates = np.asarray(jax.vmap(optimisation.rate)(jnp.arange(400))) / config.learning_rate
    np.testing.assert_allclose(rates[:11], [*np.arange(1, 11) / 10, 1.0], rtol=1e-6)
    np.testing.assert_allclose(rates[10:301], 1.0, rtol=1e-6)
    np.testing.assert_allclose(rates[[350, 399]], [0.5, 0.01], rtol=1e-5)


def test_epoch_order_is_a_new_permutation_in_every_epoch(line, config):
    state = initial_state(line.params, config, seed=0)
    orders = [np.asarray(epoch_order(state.key_data, epoch, 70)[0]) for epoch in range(3)]
    for order in orders:
        np.testing.assert_array_equal(np.sort(order), np.arange(70))
    assert not (orders[0] == orders[1]).all()
    assert not (orders[1] == orders[2]).all()
    other = initial_state(line.params, config, seed=1)
    assert not (np.asarray(epoch_order(other.key_data, 0, 70)[0]) == orders[0]).all()


def test_no_key_is_used_twice(line, config):
    state = initial_state(line.params, config, seed=0)
    keys = set()
    for epoch in range(3):
        _, steps_key = epoch_order(state.key_data, epoch, 70)
        for step in range(5):
            key = jax.random.fold_in(steps_key, step)
            keys.add(jax.random.key_data(key).tobytes())
    assert len(keys) == 15


@pytest.mark.parametrize("delays", [None, DelayDistribution.uniform((0, 1, 2))])
def test_stopping_and_going_on_gives_the_same_bits(policy, windows, config, same_bits, delays):
    whole = fit(policy, windows, config, seed=1, delays=delays)
    half = fit(policy, windows, config, seed=1, delays=delays, stop_epoch=2)
    rest = fit(policy, windows, config, seed=1, delays=delays, state=half.state)
    assert same_bits(rest.state.params, whole.state.params)
    assert same_bits(rest.state.opt_state, whole.state.opt_state)
    assert whole.history[2].loss == rest.history[0].loss
    assert [m.epoch for m in half.history + rest.history] == [1, 2, 3, 4]


def test_segment_lengths_do_not_change_the_bits(line, windows, config, same_bits, monkeypatch):
    whole = fit(line, windows, config, seed=1)
    monkeypatch.setattr(loop, "_FIRST_SEGMENT_STEPS", 1)
    monkeypatch.setattr(loop, "SEGMENT_SECONDS", 0.0)
    single = fit(line, windows, config, seed=1)
    assert same_bits(single.state.params, whole.state.params)
    assert [m.loss for m in single.history] == [m.loss for m in whole.history]


def test_two_policies_fork_from_one_state(policy, windows, config, same_bits):
    fork = fit(policy, windows, config, seed=1, stop_epoch=fork_epoch(config))
    delays = DelayDistribution.uniform((0, 1, 2))
    prefix = fit(policy, windows, config, seed=1, delays=delays, state=fork.state)
    base = fit(policy, windows, config, seed=1, state=fork.state)
    assert prefix.state.epoch == base.state.epoch == 4
    assert not same_bits(prefix.state.params, base.state.params)
    # Adam's count goes on from the fork: both had the same learning rates.
    counts = [
        int(count)
        for result in (prefix, base)
        for _, count in optax.tree.get_all_with_path(result.state.opt_state, "count")
    ]
    assert counts == [16] * 4


@pytest.mark.parametrize(("epochs", "fork"), [(32, 24), (21, 16), (4, 3), (2, 1)])
def test_fork_is_at_three_quarters(config, epochs, fork):
    assert fork_epoch(config.model_copy(update={"epochs": epochs})) == fork


def test_fork_needs_two_epochs(config):
    with pytest.raises(UsageError, match="leaves no epoch before the fork"):
        fork_epoch(config.model_copy(update={"epochs": 1}))


def test_loss_goes_down(line, windows, config):
    config = config.model_copy(update={"epochs": 40, "learning_rate": 0.01})
    history = fit(line, windows, config, seed=0).history
    assert np.mean([m.loss for m in history[-5:]]) < 0.9 * history[0].loss


def test_divergence_keeps_the_last_good_state(line, windows, config, same_bits):
    kept = []

    @jax.tree_util.register_dataclass
    @dataclasses.dataclass(frozen=True)
    class Explodes(type(line)):
        fuse: jax.Array  # data, so that both fits run one program: others may round differently

        def loss(self, observations, actions, valid, key, delays):
            loss = super().loss(observations, actions, valid, key, delays)
            return jnp.where(jnp.all(self.params["b"] == self.fuse), jnp.nan, loss)

    dud = Explodes(line.params, line.normaliser, jnp.full(2, jnp.inf))
    good = fit(dud, windows, config, seed=0, stop_epoch=1)
    bomb = dataclasses.replace(dud, fuse=good.state.params["b"])
    with pytest.raises(DivergedError, match="epoch 2") as caught:
        fit(bomb, windows, config, seed=0, on_epoch=lambda state, _: kept.append(state))
    assert caught.value.exit_code == 4
    assert [state.epoch for state in kept] == [1]
    assert same_bits(kept[0].params, good.state.params)


def test_nan_in_the_data_is_divergence_not_silence(line, windows, config, with_nan):
    config = config.model_copy(update={"batch": 70})
    with pytest.raises(DivergedError, match=r"by step 1 of 1 in epoch 1 .*learning_rate = 0.05"):
        fit(line, with_nan(windows), config, seed=0)


def test_infinite_gradient_of_a_finite_loss_is_divergence(line, windows, config):
    @jax.tree_util.register_dataclass
    @dataclasses.dataclass(frozen=True)
    class Kink(type(line)):
        def loss(self, observations, actions, valid, key, delays):
            return jnp.sum(jnp.sqrt(self.params["b"]))  # 0 with slope infinity at b = 0

    config = config.model_copy(update={"batch": 70, "epochs": 1})
    with pytest.raises(DivergedError):
        fit(Kink(line.params, line.normaliser), windows, config, seed=0)


def test_progress_counts_to_the_end(line, windows, config):
    shown = []
    fit(line, windows, config, seed=0, on_progress=shown.append)
    assert (shown[-1].step, shown[-1].steps, shown[-1].seconds_left) == (16, 16, 0.0)
    assert (shown[-1].epoch, shown[-1].epochs) == (4, 4)
    assert all(p.samples_per_s > 0 for p in shown)


def test_interrupt_in_a_callback_leaves_states_usable(line, windows, config, same_bits):
    kept = []

    def stop(state, _):
        kept.append(state)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(line, windows, config, seed=0, on_epoch=stop)
    whole = fit(line, windows, config, seed=0)
    rest = fit(line, windows, config, seed=0, state=kept[0])
    assert same_bits(rest.state.params, whole.state.params)


def test_batch_larger_than_the_data_is_refused(line, windows, config):
    with pytest.raises(UsageError, match=r"train\.batch = 71 does not fit data of 70 windows"):
        fit(line, windows, config.model_copy(update={"batch": 71}), seed=0)


def test_other_epochs_or_seed_than_the_state_are_refused(line, windows, config):
    state = fit(line, windows, config, seed=0, stop_epoch=3).state
    with pytest.raises(UsageError, match="from epoch 3 to epoch 2 of 4"):
        fit(line, windows, config, seed=0, state=state, stop_epoch=2)
    with pytest.raises(StateError, match="not trained with seed 1"):
        fit(line, windows, config, seed=1, state=state)
