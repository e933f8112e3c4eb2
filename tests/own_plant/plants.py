"""A made-up plant of any size under feedback, with its historian file and its description, for the tests of one's own plant."""

import re

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML

from helpers.own_plant.description import load_description
from helpers.own_plant.quality import examine
from helpers.own_plant.records import PlantDataError, read_records
from helpers.own_plant.settings import load_own_plant

HORIZON, HOLD = 12, 20


class MadeUpPlant:
    """A stable linear plant; `table` is what its historian records, engineering units."""

    def __init__(self, n_controlled, n_manipulated, n_cycles=30, seed=0):
        rng = np.random.default_rng(seed)
        self.n_controlled, self.n_manipulated = n_controlled, n_manipulated
        self.state_step = 0.85 * np.eye(n_controlled) + 0.03 * rng.normal(size=(n_controlled, n_controlled))
        self.input_step = 0.2 * (np.eye(n_controlled, n_manipulated) + 0.3 * rng.uniform(size=(n_controlled, n_manipulated)))
        self.steady_y, self.steady_u = 50.0 + np.arange(n_controlled), 20.0 + np.arange(n_manipulated)
        # With fewer inputs than outputs not every set point can be reached: these can.
        gain = np.linalg.solve(np.eye(n_controlled) - self.state_step, self.input_step)
        self.set_point = gain @ np.ones(n_manipulated)
        feedback = 1.5 * np.linalg.pinv(gain)
        y, integral, rows = np.zeros(n_controlled), np.zeros(n_manipulated), []
        for t in range(2 * HOLD * n_cycles):
            target = self.set_point * ((t // HOLD) % 2)
            measured = y + 0.01 * rng.normal(size=n_controlled)
            integral = integral + 0.2 * feedback @ (target - measured)
            u = np.clip(feedback @ (target - measured) + integral + 0.1 * rng.normal(size=n_manipulated), -3, 3)
            rows.append([t * 2.0, *(self.steady_y + measured), *(self.steady_y + target), *(self.steady_u + u), "AUTO"])
            y = self.state_step @ y + self.input_step @ u + 0.03 * rng.normal(size=n_controlled)
        outputs, inputs = range(n_controlled), range(n_manipulated)
        self.tags = [*(f"Y{i}.PV" for i in outputs), *(f"Y{i}.SP" for i in outputs), *(f"U{i}.OP" for i in inputs)]
        self.table = pd.DataFrame(rows, columns=["TIME", *self.tags, "MODE"])
        controlled = [
            {"name": f"y{i}", "tag": f"Y{i}.PV", "set_point_tag": f"Y{i}.SP", "unit": "%", "low": 0.0, "high": 100.0,
             "steady_state": float(self.steady_y[i]), "set_point": float(self.steady_y[i] + self.set_point[i])}
            for i in outputs
        ]  # fmt: skip
        manipulated = [
            {"name": f"u{i}", "tag": f"U{i}.OP", "unit": "%", "low": float(self.steady_u[i] - 3),
             "high": float(self.steady_u[i] + 3), "steady_state": float(self.steady_u[i])}
            for i in inputs
        ]  # fmt: skip
        pairs = range(min(n_controlled, n_manipulated))
        pid = [{"controlled": f"y{i}", "manipulated": f"u{i}", "proportional": 1.0, "integral": 0.2} for i in pairs]
        self.content = {"title": "made up", "data": "plant.csv", "time": "TIME", "time_unit": "s", "sampling_time": 2.0}
        self.content |= {"horizon": HORIZON, "mode": "MODE", "controlled": controlled, "manipulated": manipulated, "pid": pid}

    def write(self, folder, table=None, **changes):
        """Write the historian file and the description; the path of the latter. `changes` replace its keys."""
        content = self.content | changes
        table = self.table if table is None else table
        path = folder / content["data"]
        if path.suffix == ".parquet":
            table.to_parquet(path)
        else:
            table.to_csv(path, index=False)
        with (folder / "plant.yaml").open("w") as file:
            YAML().dump(content, file)
        return folder / "plant.yaml"

    def examined(self, folder, root, table=None, **changes):
        """The clean record of what `write` writes, its description, and the settings of its repair."""
        path = self.write(folder, table, **changes)
        description, params = load_description(path), load_own_plant(root).quality
        return examine(read_records(path.parent / description.data, description), description, params), description, params


def refusal(action, *arguments, **changes):
    """The one sentence by which a file is refused; it names the file."""
    with pytest.raises(PlantDataError) as caught:
        action(*arguments, **changes)
    sentence = str(caught.value)
    assert re.search(r"plant\.\w+: ", sentence)
    assert "\n" not in sentence
    return sentence
