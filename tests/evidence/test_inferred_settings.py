"""Notebook 00 goes on behind the last fit of an interrupted run, and finds the same numbers."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.evidence import inferred_settings
from helpers.runs.opening import open_identification


@pytest.fixture
def study(tmp_path):
    """A study at smoke scale."""
    given = {"seed": 0, "scale": "smoke", "input_root": "", "output_root": str(tmp_path), "params_root": ""}
    return inferred_settings.study(open_identification("00_inferred_settings", given))


def test_an_interrupted_search_goes_on_behind_its_last_fit(study, monkeypatch):
    problem, computed = study.problem(study.second), []
    fit, folder = inferred_settings.fit, study.session.finished.folder
    undisturbed = [fit(problem, study.session.scale_params, start) for start in range(2)]

    def interrupted(problem, scale, start):
        if start == 1:
            raise KeyboardInterrupt
        return fit(problem, scale, start)

    def counted(problem, scale, start):
        computed.append(start)
        return fit(problem, scale, start)

    monkeypatch.setattr(inferred_settings, "fit", interrupted)
    with pytest.raises(KeyboardInterrupt):
        study.fit(problem)
    assert len(list(folder.iterdir())) == 1
    monkeypatch.setattr(inferred_settings, "fit", counted)
    found = study.fit(problem)
    assert computed == [1]
    monkeypatch.setattr(inferred_settings, "fit", lambda *_: replace(found[0], loss=-1.0))
    assert study.fit(replace(problem, overshoot_unit=None))[0].loss == -1.0  # another problem, fitted anew
    for one, other in zip(found, sorted(undisturbed, key=lambda found: found.loss), strict=True):
        assert (one.settings, one.loss) == (other.settings, other.loss)
        assert np.array_equal(one.z, other.z)


def test_an_interrupted_profile_is_not_walked_twice(study, monkeypatch):
    problem = study.problem(study.first)
    best, key = study.refit(problem, study.filed(study.first)), next(iter(problem.free))
    walked = study.profile(problem, best, key, 4.0)
    monkeypatch.setattr(inferred_settings, "profile", None)
    again = study.profile(problem, best, key, 4.0)
    assert np.array_equal(walked.grid, again.grid)
    assert np.array_equal(walked.losses, again.losses)
    assert len(walked.grid) > 1
