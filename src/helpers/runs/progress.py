"""Progress of learning on the screen."""

import os

from tqdm.auto import tqdm

from helpers.learning.algorithm_2 import IterationRecord
from helpers.learning.learner import EpochRecord
from helpers.learning.model_gradient import GradientRecord


class ProgressBar:
    """A bar over the epochs with the latest return and, offline, the feature gap; call it with each record.

    TQDM_DISABLE=1 in the environment hides it.
    """

    def __init__(self, n_epochs: int, description: str) -> None:
        self.bar = tqdm(total=n_epochs, desc=description, unit="epoch", leave=False, disable=bool(os.environ.get("TQDM_DISABLE")))

    def __call__(self, record: EpochRecord | IterationRecord | GradientRecord) -> None:
        """Move to the record's epoch."""
        if isinstance(record, GradientRecord):
            shown = {"cost": f"{record.cost:.3f}", "movement": f"{record.movement:.2f}"}
        else:
            shown = {"return": f"{record.mean_return:.2f}"}
        if isinstance(record, IterationRecord):
            shown["feature gap"] = f"{100 * record.feature_gap:.1f} %"
        self.bar.set_postfix(shown, refresh=False)
        self.bar.update(record.epochs - self.bar.n)
        if record.epochs >= self.bar.total:
            self.bar.close()
