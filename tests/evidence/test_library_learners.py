"""The gymnasium environment against this project's own rollout, and learners of libraries as controllers of this project."""

from dataclasses import replace

import numpy as np
import pytest
import torch

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("stable_baselines3")
pytest.importorskip("sb3_contrib")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from helpers.evidence import equal_budget, limits  # noqa: E402
from helpers.evidence.gym_environment import TrackingEnv  # noqa: E402
from helpers.evidence.library_learners import HeadStartPolicy, LibraryController, TrackingEnvs, learn, library_learner  # noqa: E402
from helpers.learning.features import tracking_reward  # noqa: E402
from helpers.plant.rollout import rollout, stream  # noqa: E402
from helpers.settings.limits import load_limits  # noqa: E402


@pytest.fixture
def make(study):
    def build(**process):
        case = study(1, process=process)
        return case, TrackingEnv(case.process, case.task, case.params.learning.policy, 10.0)

    return build


@pytest.mark.filterwarnings("ignore::UserWarning")  # the observations are not bounded, by nature
def test_gymnasium_finds_nothing_wrong(make):
    check_env(make()[1], skip_render_check=True)


def test_episodes_are_those_of_the_process(make):
    """Without noise: states, rewards and what is seen, step by step through the process itself; the first also on its own."""
    case, env = make(disturbance=(0.0, 0.0), observation_noise=(0.0, 0.0))
    batch = TrackingEnvs(make(disturbance=(0.0, 0.0), observation_noise=(0.0, 0.0))[1], 3)
    batch.seed(5)
    first = batch.reset()
    env.reset(seed=3)
    env.x = batch.env.x[0]
    x, scaling = torch.tensor(batch.env.x), case.policy().scaling(case.task)
    low, high = case.task.input_low, case.task.input_high
    assert first == pytest.approx(scaling.inputs(x, torch.zeros_like(x)).numpy(), rel=1e-5, abs=1e-6)
    for action in np.random.default_rng(0).uniform(-1.5, 1.5, (env.n_steps, 3, 2)):  # some lie beyond the bounds
        seen, rewards, ends, infos = batch.step(action)
        alone, reward, over, cut, info = env.step(action[0])
        u = (high + low) / 2 + (high - low) / 2 * torch.tensor(action).clamp(-1, 1)
        x = case.process.step(x, u, torch.zeros(3, case.process.n_disturbances, dtype=x.dtype))
        last = [entry["terminal_observation"] for entry in infos] if over else seen
        assert np.array(last) == pytest.approx(scaling.inputs(x, u).numpy(), rel=1e-5, abs=1e-6)
        assert alone == pytest.approx(last[0], abs=1e-6)
        assert info["x"] == pytest.approx(x[0].numpy())
        assert info["u"] == pytest.approx(u[0].numpy())
        assert rewards == pytest.approx(tracking_reward((case.task.set_point - x) / case.task.error_scale, 10.0).numpy(), abs=1e-12)
        assert reward == pytest.approx(rewards[0], abs=1e-12)
        assert (list(ends), cut) == ([over] * 3, False)
    assert over
    assert not np.allclose(seen, first)  # the next episodes have begun, from other states
    batch.seed(5)
    assert np.array_equal(batch.reset(), first)


@pytest.mark.parametrize("inside", [False, True])
def test_a_start_at_the_head_of_a_sequence_needs_no_loop_over_time(inside):
    """Outputs, states and gradients of the library's own loop, also where an episode does start inside a sequence."""
    generator = torch.Generator().manual_seed(1)
    lstm = torch.nn.LSTM(3, 4, num_layers=2)
    features = torch.randn(5 * 7, 3, generator=generator)
    states = tuple(torch.randn(2, 5, 4, generator=generator) for _ in range(2))
    starts = torch.zeros(5, 7)
    starts[[0, 3], 0] = 1.0
    starts[1, 4] = float(inside)
    found = []
    for policy in (HeadStartPolicy, HeadStartPolicy.__base__):
        lstm.zero_grad()
        output, (hidden, cell) = policy._process_sequence(features, states, starts.flatten(), lstm)
        output.square().sum().backward()
        found.append([output, hidden, cell, *(weight.grad.clone() for weight in lstm.parameters())])
    assert all(torch.allclose(mine, its, atol=1e-5) for mine, its in zip(*found, strict=True))


@pytest.mark.parametrize("name", ["ppo", "recurrent_ppo"])
def test_learners_learn_and_become_controllers(study, root, name):
    case = study(1)
    params = getattr(load_limits(root, case.params), name).model_copy(update={"passes": 1, "minibatches": 2})
    model = library_learner(name, case.process, case.task, case.params.learning.policy, params, 0.99, 4, 0)
    visits, betas = [], []
    before = [weight.clone() for weight in model.policy.parameters()]
    learn(model, case.task, 8, lambda episodes: betas.append(episodes) or 10.0, visits.append)
    assert visits == [0, 4, 8]
    assert betas == [0, 4]
    assert any(not torch.equal(old, new) for old, new in zip(before, model.policy.parameters(), strict=True))
    controller = LibraryController(model, case.task, case.policy().scaling(case.task))
    batch = rollout(case.process, controller, case.task, 3, stream(0, "library"))
    assert batch.u.isfinite().all()
    again = rollout(case.process, controller, case.task, 3, stream(0, "library"))
    assert torch.equal(batch.u, again.u)  # its mode, from a fresh state


@pytest.mark.parametrize("name", ["ppo", "recurrent_ppo"])
def test_an_interrupted_run_does_not_repeat_a_learner_that_has_ended(opened, monkeypatch, name):
    contest = limits.enter(opened("06_limits_and_alternatives", case=2))
    scale = contest.scale.model_copy(update={"episodes": 100, "every": 50, "judged": 20})
    contest = replace(contest, limits=contest.limits.model_copy(update={"scales": {"smoke": scale}}))
    first = equal_budget.from_library(contest, name)
    monkeypatch.setattr("helpers.evidence.library_learners.learn", None)
    again = equal_budget.from_library(contest, name)
    assert [episodes for episodes, *_ in first.curve] == [0, 50, 100]
    assert again.curve == first.curve
    one, other = (contest.session.fresh(found.build(contest.session), 20).u for found in (first, again))
    assert torch.equal(one, other)
