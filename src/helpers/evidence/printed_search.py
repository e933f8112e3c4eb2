"""The best that Algorithms 1 and 2 do as printed: a search over what the paper does not give.

What is printed stays: the whole return less its mean, one gradient step an epoch, a constant step size, the last policy and the
last weights, the paper's epochs, outer iterations and network. Searched are the learning rate (of Adam), step and start of alpha,
episodes an epoch, exploration, patience, and how far the policy answers at the start.

The settings are a scrambled Sobol design and are tried in rungs: all on one seed, the best on a few, the best of these on all.
No trial is cut short by its looks on the way: of the pilot's sixteen in Case I, two whose gaps were 1,000 and 200 % after the first
of four outer iterations ended at 25 and 14 %. A trial is kept as it ends, so that a kill loses no other.
"""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from inspect import getsource
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import pandas as pd
from scipy.stats import qmc
from torch import Tensor

from helpers.learning.algorithm_2 import IterationRecord, algorithm_2
from helpers.learning.features import feature_names
from helpers.learning.learner import TrainingError
from helpers.learning.policy import LSTMPolicy
from helpers.plant.rollout import rollout
from helpers.runs.finished import Finished, State
from helpers.runs.identity import digest, versions
from helpers.runs.sources import code_behind
from helpers.runs.study import Demonstrations, Study, copied
from helpers.settings.paper import ExplorationParams, Params, load
from helpers.settings.search import PrintedSearchParams, RangeParams, SearchScaleParams, load_search

VARIANT = "printed"
MADE_BY = "02_offline_irl"  # the notebook whose code a trial runs
DIGITS = 3  # significant ones of a setting, so that the table tells it whole
CHOICES = ("patience", "initial")
FIGURES = ("gap", "iterations", "epochs", "seconds")
Setting = dict[str, Any]


def design(ranges: RangeParams, n_settings: int, seed: int = 0) -> list[Setting]:
    """The first points of a scrambled Sobol sequence (Owen 1998) as settings, by the names of `RangeParams`."""
    names = list(RangeParams.model_fields)

    def place(name: str, share: float) -> Any:
        given = getattr(ranges, name)
        if name in CHOICES:
            return given[int(share * len(given))]
        low, high = given
        value = float(f"{low * (high / low) ** share:.{DIGITS}g}")
        return round(value) if name == "episodes" else value

    points = qmc.Sobol(len(names), rng=seed).random(n_settings).tolist()
    return [{name: place(name, share) for name, share in zip(names, point, strict=True)} for point in points]


def configured(params: Params, setting: Setting) -> Params:
    """The parameters with the variant `printed` at a setting."""
    learning = params.learning
    printed, high, lowest = learning.variants[VARIANT], setting["std_high"], learning.policy.std_low
    rates = dict.fromkeys(("learning_rate_start", "learning_rate_end"), setting["learning_rate"])
    changed = {
        "learner": printed.learner.model_copy(update=rates | {"patience": setting["patience"]}),
        "weights": printed.weights.model_copy(update={"step": setting["weight_step"], "initial": setting["initial"]}),
        "exploration": ExplorationParams.model_construct(
            std_low=lowest, std_high=high, initial_std=lowest + setting["std_share"] * (high - lowest)
        ),
        "initial_output_scale": setting["output_scale"],
        "episodes": setting["episodes"],
    }
    variants = learning.variants | {VARIANT: printed.model_copy(update=changed)}
    return replace(params, learning=learning.model_copy(update={"variants": variants}))


def recorded(study: Study) -> Demonstrations:
    """What notebook 01 records: the demonstrations, and the expert's own figures on many fresh trajectories."""
    scale = study.scale_params
    found = rollout(study.process, study.expert, study.task, scale.demonstrations, study.stream("demonstrations"))
    return Demonstrations(found, pd.Series(study.judge(study.fresh(study.expert, scale.expert_evaluation))))


def trained(study: Study, policy: LSTMPolicy, start: Tensor | None) -> State:
    """Algorithm 2 from a policy and weights, judged: gap, iterations, epochs, seconds of the processor, weights and policy.

    The gap of a training that cannot go on is infinite.
    """
    began, demonstrations, records = time.process_time(), recorded(study), list[IterationRecord]()
    learner, v_expert, alpha, n_iterations = study.apprentice(demonstrations, policy, start)
    measured, gap = study.scale_params.measured, math.inf
    try:
        found = algorithm_2(learner, v_expert, alpha, study.variant_params.weights, n_iterations, measured, records.append)
        gap = study.judge_imitation(study.fresh(found.policy), demonstrations, found)["feature_gap"]
        alpha, policy = found.weights, found.policy
    except TrainingError:
        pass
    spent = {"iterations": len(records), "epochs": learner.epochs, "seconds": time.process_time() - began}
    return {"gap": gap, **spent, "weights": alpha, "policy": policy.state_dict()}


@dataclass(frozen=True)
class Search:
    """The search at one scale for the parameter files in a folder.

    Attributes:
        kept: where trials are kept as they end.
    """

    root: Path
    scale: str
    kept: Path

    @cached_property
    def params(self) -> PrintedSearchParams:
        """params/search.yaml."""
        return load_search(self.root)

    @property
    def size(self) -> SearchScaleParams:
        """How much this scale searches."""
        return self.params.scales[self.scale]

    @cached_property
    def settings(self) -> list[Setting]:
        """The setting by hand, then the design; the same in all cases."""
        return [self.params.by_hand.model_dump(), *design(self.params.ranges, self.size.settings)]

    @cached_property
    def finished(self) -> Finished:
        """The trials that have ended, of the code and packages as they are now."""
        return Finished(self.kept, digest([versions(), code_behind(MADE_BY), getsource(recorded), getsource(trained)]))

    def study(self, case: int, seed: int, setting: Setting | None = None) -> Study:
        """A case with the variant `printed`, at a setting or as in learning.yaml."""
        params = load(self.root, case)
        params = configured(params, setting) if setting else params
        return Study(params=params, scale_params=params.learning.scales[self.scale], seed=seed, case=case, variant=VARIANT)

    def trial(self, case: int, number: int, seed: int, best: Mapping[int, int]) -> State:
        """What a setting gave on a seed, as kept or made now: see `trained`.

        A case that starts from another one starts from the best setting there, that by hand from that by hand.

        Args:
            best: number of the best setting of each case that was searched before.
        """
        study = self.study(case, seed, self.settings[number])
        source, policy, start = study.params.case.offline.transfer_from, study.fresh_policy(), None
        if source is not None:
            before = self.trial(source, number and best[source], seed, best)
            policy, start = copied(policy, before["policy"]), before["weights"]
        return self.once(lambda: trained(study, policy, start), study, study.variant_params, *policy.state_dict().values())

    def once(self, compute: Callable[[], State], study: Study, *start: Any) -> State:
        """What a computation on a study gives, as kept or made now; `start`: all it depends on beside process, case and scale."""
        params = study.params
        given = (params.process, params.demonstrator, params.features, params.case, params.learning.policy, study.scale_params)
        return self.finished.once(compute, study.case, study.seed, *given, *start)

    def run(self, case: int, best: Mapping[int, int], watch: Callable[[str], object] = print) -> tuple[int, pd.DataFrame]:
        """The best setting of a case, and every trial: case, setting, seed, rung, `FIGURES`, alpha*, and the setting's entries.

        Settings are ranked by the median of their gaps over the seeds of a rung. The first, that by hand, takes part to the end.
        """
        size, ranked = self.size, list(range(len(self.settings)))
        n_last = size.last[min(case, len(size.last)) - 1]
        names = feature_names(load(self.root, case).process.controlled)
        rows: dict[tuple[int, int], Setting] = {}
        for rung, (n_settings, n_seeds) in enumerate(
            ((len(ranked), 1), (size.finalists, size.finalist_seeds), (n_last, size.seeds))
        ):
            tried = sorted({0, *ranked[:n_settings]})
            for number, seed in product(tried, range(n_seeds)):
                if (number, seed) in rows:
                    continue
                found = self.trial(case, number, seed, best)
                row = {"case": case, "setting": number, "seed": seed, "rung": rung + 1} | {name: found[name] for name in FIGURES}
                row |= {f"alpha:{name}": value for name, value in zip(names, found["weights"].tolist(), strict=True)}
                rows[number, seed] = row | self.settings[number]
                watch(f"case {case}, setting {number}, seed {seed}: gap {100 * found['gap']:.1f} %, {found['seconds']:.0f} s")
            gaps = {number: median(rows[number, seed]["gap"] for seed in range(n_seeds)) for number in tried}
            ranked = sorted(tried, key=gaps.__getitem__)
        return ranked[0], pd.DataFrame(rows.values()).astype(dict.fromkeys(RangeParams.model_fields, object))
