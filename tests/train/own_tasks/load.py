"""Hover with a slung load in the wind."""

import jax
import jax.numpy as jnp
from hands import fly_to

from crazysim import SlungLoad, Wind, rotation, state
from crazysim.envs import Task, draw, flying, state_of, terms


class WindyLoad(Task):
    """Bring a load on a rod to a point, and hold it there in a wind of up to 1.5 m/s."""

    name = "windy_load"

    tolerance: float = 0.12
    seconds: float = 6.0
    goal: jax.Array = state((3,))

    def install(self, sim):
        sim.add(SlungLoad(mass=0.006, length=0.3))
        sim.add(Wind(jnp.zeros((sim.n_worlds, sim.n_drones, 3))))
        self.add_states(sim)

    def spawn(self, data, key):
        x = draw(key, data.core.n_drones, start=3, goal=3, wind=2)
        start, goal = ((2 * x[name] - 1) * jnp.array([0.8, 0.8, 0.3]) for name in ("start", "goal"))
        data = flying(data, start + jnp.array([0.0, 0.0, 1.4]))
        load, wind = data.plugins["load"], data.plugins["wind"]
        load = load.replace(pos=data.states.pos - jnp.array([0.0, 0.0, 0.3]), vel=jnp.zeros_like(load.vel))
        velocity = jnp.concatenate([3 * x["wind"] - 1.5, 0 * x["wind"][:, :1]], axis=-1) / jnp.sqrt(2.0)
        plugins = data.plugins | {"load": load, "wind": wind.replace(velocity=velocity)}
        return self.write(data.replace(plugins=plugins), goal=goal + jnp.array([0.0, 0.0, 1.1]))

    def to_goal(self, data):
        """Return the vector from the load to its goal, m. (n_drones, 3)"""
        return self.read(data).goal - data.plugins["load"].pos

    def error(self, data):
        return rotation.safe_norm(self.to_goal(data))[..., 0]

    def observe(self, data):
        s, load = data.states, data.plugins["load"]
        return state_of(data) | {
            "load": load.pos - s.pos,
            "load_vel": load.vel - s.vel,
            "to_goal": self.to_goal(data),
        }

    def failed(self, data):
        height = data.plugins["load"].pos[:, 2]
        return (height < 0.05) | (data.states.pos[:, 2] > 3.0)

    def rewards(self, data, action, last_action):
        return {
            "near": terms.proximity(self.error(data)),
            "swing": -0.02 * jnp.sum(data.plugins["load"].vel ** 2, axis=-1),
            "action_rate": -0.02 * terms.action_rate(action, last_action),
            "failed": -10.0 * self.failed(data),
        }

    def terminated(self, data):
        return jnp.any(self.failed(data))

    @staticmethod
    def demonstrate(obs):
        """Lean towards the goal of the load, and after the load where it swings."""
        way = jnp.clip(obs["to_goal"], -0.5, 0.5) + 0.6 * obs["load"] * jnp.array([1.0, 1.0, 0.0])
        action = fly_to(way, obs["vel"] - 0.3 * obs["load_vel"], gain=1.1, damping=0.7)
        return action.at[..., 3].add(0.15)  # the weight of the load
