"""Episodes and stretches out of a record: where they begin, what they hold, and why some do not count."""

import numpy as np
import pytest
import torch

from helpers.own_plant.episodes import episodes, stretches
from helpers.settings.leaf import InputError
from tests.own_plant.plants import HOLD, HORIZON, MadeUpPlant

CYCLES = 15
ONE, TWO = MadeUpPlant(1, 1, CYCLES), MadeUpPlant(2, 2, CYCLES)
GAPS = ONE.table[~(ONE.table.index % HOLD).isin(range(5, 15))]
STILL = ONE.table.assign(**{"Y0.SP": 50.0})  # its set point never moves
REST, GOAL = (f"{value:g}" for value in (ONE.steady_y[0], ONE.steady_y[0] + ONE.set_point[0]))


@pytest.fixture
def cut(tmp_path, root):
    def found(plant, table=None, **changes):
        clean, description, params = plant.examined(tmp_path, root, table, **changes)
        return clean, description, episodes(clean, description, params, torch.float64)

    return found


def test_episodes_begin_at_the_steps_to_the_task_s_set_point(cut):
    plant = MadeUpPlant(2, 3, CYCLES)
    _, description, found = cut(plant)
    assert found.trajectories.y.shape == (HORIZON + 1, CYCLES, 2)
    assert found.trajectories.u.shape == (HORIZON, CYCLES, 3)
    assert found.starts == tuple(range(2 + HOLD, 2 + 2 * HOLD * CYCLES, 2 * HOLD))
    rows = plant.table.iloc[3 * HOLD : 3 * HOLD + HORIZON + 1]
    assert found.trajectories.y[:, 1].numpy() == pytest.approx(rows[["Y0.PV", "Y1.PV"]].to_numpy() - plant.steady_y)
    assert found.trajectories.u[:, 1].numpy() == pytest.approx(rows[["U0.OP", "U1.OP", "U2.OP"]].to_numpy()[:-1] - plant.steady_u)
    assert found.before[1].numpy() == pytest.approx(plant.table.loc[3 * HOLD - 1, ["U0.OP", "U1.OP", "U2.OP"]] - plant.steady_u)
    assert not any(found.left_out.values())
    task = description.task(torch.zeros(2), torch.zeros(2), torch.float64)
    assert task.set_point.numpy() == pytest.approx(plant.set_point)
    assert task.input_low.tolist() == [-3.0] * 3


def test_episodes_that_a_gap_an_operator_or_a_new_set_point_spoils_do_not_count(cut):
    table = TWO.table.copy()
    table.loc[HOLD + 4, "MODE"] = "MAN"
    table.loc[3 * HOLD + 5 : 3 * HOLD + 30, "Y0.SP"] = TWO.steady_y[0] - 2
    _, _, found = cut(TWO, table.drop(index=range(5 * HOLD + 3, 5 * HOLD + 11)))
    assert found.left_out == {"cut short by a break": 1, "not in automatic": 1, "set point moved again": 1}
    assert found.trajectories.n_trajectories == CYCLES - 3


def loop(**changes):
    """The one loop described otherwise."""
    return {"controlled": [{key: value for key, value in (ONE.content["controlled"][0] | changes).items() if value is not None}]}


@pytest.mark.parametrize(
    ("table", "changes", "says"),
    [
        (GAPS, {}, "0 episodes of 12 samples .* expected 10 or more; left out: 15 cut short"),
        (ONE.table.iloc[: 2 * HOLD], {"horizon": 100}, "0 episodes of 100 samples .* left out: 1 cut short"),  # a short record
        (ONE.table, loop(set_point=80.0), f"'Y0.SP': the set points lie between {REST} and {GOAL}, none is .* 80 %: change"),
        (ONE.table, loop(set_point=80.0, set_point_tag=None), "'Y0.PV': lies between 49.* never near the set point, .* 80 %"),
        (ONE.table, loop(steady_state=40.0), f"0 episodes .* left out: .* {CYCLES} not from 'steady_state'"),
        (STILL, {}, "'Y0.SP': the set points stay at 50, none is .*: change 'set_point' of 'y0', .*'error_scale'"),
        (STILL, loop(set_point=50.0), "give 'error_scale'"),
        (STILL, loop(set_point=50.0, steady_state=48.0) | {"horizon": 99}, "6 episodes of 99 samples at the set point of the task"),
    ],
)
def test_a_record_without_the_task_is_refused_with_the_reason(cut, table, changes, says):
    with pytest.raises(InputError, match=rf"plant\.\w+: .*{says}"):
        cut(ONE, table, **changes)


@pytest.mark.parametrize("still", [{"steady_state": 48.0}, {"error_scale": 0.5}])
def test_a_record_whose_set_point_never_moves_gives_stretches(cut, still):
    _, _, found = cut(ONE, STILL, **loop(set_point=50.0, **still))
    assert found.trajectories.n_trajectories == 2 * HOLD * CYCLES // (HORIZON + 1)


def test_after_a_break_the_input_before_is_the_first_of_the_episode(cut):
    table = STILL.copy()
    table.loc[100:129, "U0.OP"] = np.nan
    _, _, found = cut(ONE, table, **loop(set_point=50.0, error_scale=0.5))
    assert found.before.isfinite().all()
    inputs = table["U0.OP"].to_numpy() - ONE.steady_u
    episode = found.starts.index(130 + 2)
    assert found.before[episode].item() == pytest.approx(inputs[130])
    assert found.before[episode + 1].item() == pytest.approx(inputs[130 + HORIZON])
    assert found.before[0].item() == pytest.approx(inputs[0])


def test_stretches_hold_every_usable_row_in_deviation_variables(cut):
    clean, description, _ = cut(TWO, TWO.table.drop(index=range(100, 110)))
    pieces = stretches(clean, description, 10)
    assert [len(piece) for piece in pieces] == [100, len(TWO.table) - 110]
    assert pieces[1].y[0] == pytest.approx(TWO.table.loc[110, ["Y0.PV", "Y1.PV"]].to_numpy(dtype=float) - TWO.steady_y)
    assert len(stretches(clean, description, 101)) == 1
    assert np.isfinite(pieces[0].u).all()
