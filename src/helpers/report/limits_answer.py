"""What a practitioner can read off the numbers of notebook 06, in words; every number comes from its tables."""

import pandas as pd

from helpers.report.limits_figures import LABELS

NO_LEARNERS = ("clone", "mpc", "one_policy")
WITH_MODEL = ("one_policy", "mpc", "minimum_variance", "minimum_variance_filtered")


def answer(found: pd.DataFrame, budget: pd.DataFrame) -> str:
    """Who learns best from how many plant episodes, and what those reach that have the exact model instead.

    `found` has the columns objective and gap (per cent below the programme), index controller; `budget` the objective of each
    learner (index) after so many episodes (columns), and of those that spend none, from fewer draws.
    """
    learners = budget.drop(index=list(NO_LEARNERS), errors="ignore")
    paid = learners[[number for number in learners if int(number)]]
    best = paid.idxmax()
    lines = [f"after {number:,} episodes {LABELS[best[number]]} is best, $J$ = {paid[number].max():.1f}" for number in paid]
    model = {name: found.loc[name] for name in WITH_MODEL if name in found.index}
    known = ", ".join(f"{LABELS[name]} {row['objective']:.1f} ({row['gap']:.1f} %)" for name, row in model.items())
    ahead = learners.columns[(learners > budget.loc["mpc"]).any()]
    passed = f"from {ahead[0]:,} episodes on" if len(ahead) else "at none of these budgets"
    return (
        f"**Learning on the plant**: {'; '.join(lines)}. **With the exact model** and no episode at all (in brackets the gap to "
        f"the programme): {known}. A learner passes offset-free MPC {passed}. "
        f"The best learner ends {found.loc[best.iloc[-1], 'gap']:.1f} % below the programme, "
        f"the demonstrator stands {found.loc['expert', 'gap']:.1f} % below it."
    )
