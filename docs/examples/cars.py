"""Two cars with trailers on a figure eight, under a linear quadratic regulator, and a picture of one of them."""

import jax
import numpy as np

from crazysim import Cars, Sim
from crazysim.plugins import vehicles
from crazysim.trajectories import figure_eight


def main(picture=False):
    sim = Sim(n_worlds=2)
    path = figure_eight(6.0, 2.0, period=14.0)
    cars = sim.add(Cars(2, vehicle="aiml_head", path=path, controller=vehicles.PathLQR(), trailer=True))
    sim.step(3000)
    car = cars.read(sim.data)
    paths, pos = car.path, car.pos[0, :, :2]
    nearest = jax.jit(jax.vmap(lambda pos, arc: paths.point_at(0, paths.project(0, pos, arc)).pos))(
        pos, car.arc[0, :, 0]
    )
    print("errors", np.linalg.norm(pos - nearest, axis=-1), "m; speeds", car.body_vel[0, :, 0], "m/s")
    if picture:
        view = {"lookat": car.pos[0, 0], "distance": 2.0, "azimuth": 120, "elevation": -25}
        return sim.render("rgb_array", width=640, height=480, cam_config=view)
    return None


if __name__ == "__main__":
    main()
