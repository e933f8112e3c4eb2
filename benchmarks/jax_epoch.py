"""The same epoch in JAX, as many would write it: one `scan` through the closed loop, its `vjp` and Adam, compiled together.

It has the mathematics of the project's learner with one gradient step an epoch, credit `reward_to_go` and features of x.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.nn import leaky_relu, relu6, sigmoid
from torch import Tensor

from helpers.learning.learner import Learner
from helpers.plant.process import LinearProcess


class JaxLearner:
    """One epoch in JAX, compiled at its first call; starts from the numbers of the project's own `learner`."""

    def __init__(self, learner: Learner, alpha: Tensor) -> None:
        """`alpha`: weights of the reward, shape (d,)."""
        self.features, self.params, self.policy = learner.features, learner.params, learner.policy.params
        names = ("drift_state", "drift_input", "disturbance_gain", "observation_noise")
        process = learner.process
        assert isinstance(process, LinearProcess)
        self.steps, self.tau = process.integration_steps, process.tau
        self.process: dict[str, np.ndarray] = {name: getattr(process, name).numpy() for name in names}
        self.task = {name: value.numpy() for name, value in vars(self.features.task).items() if name != "n_steps"}
        self.task["error_unit"] = learner.policy.error_unit.numpy()
        self.alpha, self.shape = alpha.numpy(), (self.features.task.n_steps, learner.n_episodes)
        self.theta = {name: jnp.array(value.detach().numpy()) for name, value in learner.policy.named_parameters()}
        self.moments = (jax.tree.map(jnp.zeros_like, self.theta), jax.tree.map(jnp.zeros_like, self.theta), 0)
        self.key, self.compiled = jax.random.key(0), jax.jit(self.update)

    def noise(self, key: jax.Array) -> dict[str, jax.Array]:
        """All random numbers of a batch, standard normal: of start, process, sensors and exploration; time first."""
        (T, K), (n_x, n_u) = self.shape, self.process["drift_input"].shape
        shapes = {"start": (K, n_x), "process": (T, K, self.steps * n_x), "sensors": (T + 1, K, n_x), "exploration": (T, K, n_u)}
        keys = jax.random.split(key, len(shapes))
        return {name: jax.random.normal(key, shape) for key, (name, shape) in zip(keys, shapes.items(), strict=True)}

    def episodes(self, theta: dict, noise: dict) -> tuple[jax.Array, dict[str, jax.Array]]:
        """ln pi of the commands, shape (T, K), and of a batch x_1..x_T, y_0..y_{T-1}, u_0..u_{T-1} and the commands."""
        process, task, params = self.process, self.task, self.policy
        span, std_low, std_high = task["input_high"] - task["input_low"], params.std_low, params.std_high
        x = task["initial_mean"] + task["initial_std"] * noise["start"]
        y = x * (1 + process["observation_noise"] * noise["sensors"][0])
        states = [(jnp.zeros((len(x), n)), jnp.zeros((len(x), n))) for n in params.hidden_cells]

        def step(carry: tuple, draw: tuple) -> tuple:
            x, y, before, states = carry
            exploration, disturbance, sensors = draw
            middle = (2 * before - task["input_high"] - task["input_low"]) / span
            signal, following = jnp.concatenate([(task["set_point"] - y) / task["error_unit"], middle], axis=-1), []
            for layer, (h_before, c_before) in enumerate(states):
                below, recurrent, bias, second = (
                    theta[f"layers.{layer}.{kind}_l0"] for kind in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
                )
                entry, forget, candidate, exit_ = jnp.split(signal @ below.T + h_before @ recurrent.T + bias + second, 4, axis=-1)
                c = sigmoid(forget) * c_before + sigmoid(entry) * jnp.tanh(candidate)
                h = sigmoid(exit_) * jnp.tanh(c)
                following.append((h, c))
                signal = leaky_relu(h, params.leaky_slope)
            mean, std = jnp.split(relu6(signal @ theta["output.weight"].T + theta["output.bias"]) / 6, 2, axis=-1)
            mean, std = task["input_low"] + span * mean, span * (std_low + (std_high - std_low) * std)
            command = jax.lax.stop_gradient(mean + std * exploration)
            log_probability = (-(((command - mean) / std) ** 2) / 2 - jnp.log(std) - np.log(2 * np.pi) / 2).sum(-1)
            u = jnp.clip(command, task["input_low"], task["input_high"])
            after = x
            for w in jnp.split(disturbance, self.steps, axis=-1):
                drift = after @ process["drift_state"].T + u @ process["drift_input"].T
                after = after + drift * self.tau + process["disturbance_gain"] * self.tau**0.5 * after * w
            seen = after * (1 + process["observation_noise"] * sensors)
            return (after, seen, u, following), (log_probability, {"x": after, "y": y, "u": u, "command": command})

        draws = (noise["exploration"], noise["process"], noise["sensors"][1:])
        return jax.lax.scan(step, (x, y, jnp.zeros_like(noise["exploration"][0]), states), draws)[1]

    def advantage(self, batch: dict[str, jax.Array]) -> jax.Array:
        """Reward-to-go less a regression on what was known, in units of its spread, shape (T, K)."""
        task, params, dt = self.task, self.features.params, self.features.sampling_time
        error = (task["set_point"] - batch["x"]) / task["error_scale"]
        size = jnp.abs(error)
        rate = jnp.diff(size, axis=0, prepend=jnp.full_like(size[:1], params.initial_error)) / dt
        phi = jnp.concatenate([jnp.exp(-((params.beta * error) ** 2)), jnp.cumsum(size, axis=0) * dt, rate], axis=-1)
        t = np.arange(len(error))
        future = np.triu(self.params.credit_decay ** (t - t[:, None])) @ (params.discount ** t[:, None] * (phi @ self.alpha))
        seen = (task["set_point"] - batch["y"]) / task["error_scale"]
        before = jnp.concatenate([jnp.zeros_like(batch["u"][:1]), batch["u"][:-1]]) / (task["input_high"] - task["input_low"])
        known = [jnp.ones_like(seen[..., :1]), seen, jnp.abs(seen), seen**2, jnp.cumsum(jnp.abs(seen), axis=0) * dt, before]
        design = jnp.concatenate(known, axis=-1)
        ridge = 1e-3 * design.shape[1] * np.eye(design.shape[-1])
        transposed = design.swapaxes(1, 2)
        found = future - (design @ jnp.linalg.solve(transposed @ design + ridge, transposed @ future[..., None]))[..., 0]
        return found / found.std(ddof=1)

    def gradient(self, theta: dict, noise: dict) -> dict[str, jax.Array]:
        """The policy gradient, Eq. 3.2.4, by parameter."""
        _, pullback, batch = jax.vjp(lambda theta: self.episodes(theta, noise), theta, has_aux=True)
        return pullback(self.advantage(batch) / self.shape[1])[0]

    def update(self, theta: dict, moments: tuple, key: jax.Array) -> tuple:
        """Parameters, Adam's moments and the key after one epoch."""
        key, now = jax.random.split(key)
        gradient, (first, second, n) = self.gradient(theta, self.noise(now)), moments
        first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, gradient)
        second = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g**2, second, gradient)
        rate = self.params.learning_rate_start * jnp.sqrt(1 - 0.999 ** (n + 1)) / (1 - 0.9 ** (n + 1))
        theta = jax.tree.map(lambda p, m, v: p + rate * m / (jnp.sqrt(v) + 1e-8), theta, first, second)
        return theta, (first, second, n + 1), key

    def epoch(self) -> None:
        """One epoch, to its end."""
        self.theta, self.moments, self.key = jax.block_until_ready(self.compiled(self.theta, self.moments, self.key))
