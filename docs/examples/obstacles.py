"""Fly past two poles at a different place in each of eight worlds, and print which drones touch them.

The poles are mocap bodies, so they move without recompiling the scene. The contact check is compiled into the flight:
it closes over the scene and takes only the data of the simulation and the positions of the poles.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from crazysim import Sim, SimData
from crazysim import functional as F
from crazysim.sim import sync_sim2mjx

N_WORLDS = 8
SPEED = 0.8
"""Speed of the drones along x, m/s."""
SECONDS = 3.0
CHECKS_PER_SECOND = 50
POLE = """
<mujoco>
  <worldbody>
    <body name="pole">
      <geom name="pole" type="capsule" fromto="0 0 0.05 0 0 1.5" size="0.03" rgba="0.85 0.35 0.25 1"/>
    </body>
  </worldbody>
</mujoco>
"""


def build() -> tuple[Sim, Array]:
    """Return a simulation with two poles, and their positions, which shift sideways by 4 cm from world to world.

    A drone and a pole touch within 11.6 cm of each other.
    """
    sim = Sim(n_worlds=N_WORLDS, control="state")
    pole = mujoco.MjSpec.from_string(POLE).body("pole")
    frame = sim.spec.worldbody.add_frame()
    for k in range(2):
        frame.attach_body(pole, "pole_", f":{k}").mocap = True
    sim.build_mjx()

    poles = [sim.mj_model.body(f"pole_pole:{k}").mocapid.item() for k in range(2)]
    offset = 0.04 * np.arange(N_WORLDS)
    places = np.zeros((N_WORLDS, 2, 3))
    places[:, 0, :2] = np.stack([np.full(N_WORLDS, 0.8), offset], axis=-1)
    places[:, 1, :2] = np.stack([np.full(N_WORLDS, 1.6), offset - 0.28], axis=-1)
    mocap_pos = sim.mjx_data.mocap_pos.at[:, jnp.array(poles)].set(places)

    states = sim.data.states
    sim.data = sim.data.replace(states=states.replace(pos=states.pos.at[..., 2].set(0.7)))
    return sim, mocap_pos


def main() -> None:
    """Fly past the poles, and print the first contact with each pole in each world."""
    sim, mocap_pos = build()
    step = sim.build_step_fn()
    _mjx_data, mjx_model = sim.mjx_data, sim.mjx_model
    drone, *poles = (sim.mj_model.geom(name).id for name in ("col_sphere:0", "pole_pole:0", "pole_pole:1"))

    def check_contacts(sim_data: SimData, obstacle_mocap_pos: Array) -> Array:
        mjx_data = _mjx_data.replace(mocap_pos=obstacle_mocap_pos)
        _, mjx_data = sync_sim2mjx(sim_data, mjx_data, mjx_model)
        contact = mjx_data._impl.contact

        def touches(a: int, b: int) -> Array:
            pair = ((contact.geom1 == a) & (contact.geom2 == b)) | ((contact.geom1 == b) & (contact.geom2 == a))
            return jnp.any(pair & (contact.dist < 0), axis=-1)

        return jnp.stack([touches(drone, pole) for pole in poles], axis=-1)

    def advance(data: SimData, mocap_pos: Array) -> tuple[SimData, Array]:
        time = data.core.steps[..., None] / data.core.freq
        pos = SPEED * time * jnp.array([1.0, 0.0, 0.0]) + jnp.array([0.0, 0.0, 0.7])
        data = F.state_control(data, pos=pos, vel=[SPEED, 0.0, 0.0])
        data = step(data, sim.freq // CHECKS_PER_SECOND)
        return data, check_contacts(data, mocap_pos)

    @jax.jit
    def fly(data: SimData, mocap_pos: Array) -> tuple[SimData, Array]:
        return jax.lax.scan(lambda d, _: advance(d, mocap_pos), data, length=int(SECONDS * CHECKS_PER_SECOND))

    _, touching = fly(sim.data, mocap_pos)
    touching = np.asarray(touching)  # (checks, worlds, poles)
    for world in range(N_WORLDS):
        hits = [
            f"pole {k} after {(np.argmax(touching[:, world, k]) + 1) / CHECKS_PER_SECOND:.2f} s"
            for k in range(2)
            if touching[:, world, k].any()
        ]
        print(f"world {world}: touched {' and '.join(hits) or 'nothing'}")


if __name__ == "__main__":
    main()
