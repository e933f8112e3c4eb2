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
    learners = budget.drop(index=[name for name in NO_LEARNERS if name in budget.index])
    lines = []
    for episodes in (number for number in budget.columns if int(number)):
        best = learners[episodes].idxmax()
        lines.append(f"after {episodes:,} episodes {LABELS[best]} is best, $J$ = {learners.loc[best, episodes]:.1f}")
    model = {name: found.loc[name] for name in WITH_MODEL if name in found.index}
    known = ", ".join(f"{LABELS[name]} {row['objective']:.1f} ({row['gap']:.1f} %)" for name, row in model.items())
    ahead = learners.columns[(learners > budget.loc["mpc"]).any()]
    passed = f"from {ahead[0]:,} episodes on" if len(ahead) else "at none of these budgets"
    best = learners.iloc[:, -1].idxmax()
    return (
        f"**Learning on the plant**: {'; '.join(lines)}. **With the exact model** and no episode at all (in brackets the gap to "
        f"the programme): {known}. A learner passes offset-free MPC {passed}. The best learner ends {found.loc[best, 'gap']:.1f} % "
        f"below the programme, the demonstrator stands {found.loc['expert', 'gap']:.1f} % below it."
    )
