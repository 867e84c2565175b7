"""A script written for Crazyswarm2, with its import changed: three drones turn in a circle and land."""

import numpy as np

from crazysim import Sim
from crazysim.lab.live import Swarm
from crazysim.lab.live.crazyflie_py import Crazyswarm, use  # was: from crazyflie_py import Crazyswarm

HEIGHT, RADIUS, TURN = 1.0, 0.6, 6.0


def main():
    use(Swarm(Sim(n_drones=3, control="state", controller="geometric")))  # without it: crazyflies.yaml, or one drone
    swarm = Crazyswarm()
    timeHelper = swarm.timeHelper
    allcfs = swarm.allcfs

    allcfs.takeoff(targetHeight=HEIGHT, duration=2.0)
    timeHelper.sleep(2.5)
    phases = 2 * np.pi * np.arange(len(allcfs.crazyflies)) / len(allcfs.crazyflies)
    for cf, phase in zip(allcfs.crazyflies, phases, strict=True):
        cf.goTo([RADIUS * np.cos(phase), RADIUS * np.sin(phase), HEIGHT], yaw=0.0, duration=2.5)
    timeHelper.sleep(3.0)

    start_time, rate, errors = timeHelper.time(), 2 * np.pi / TURN, []
    while timeHelper.time() - start_time < TURN:
        for cf, phase in zip(allcfs.crazyflies, phases, strict=True):
            angle = phase + rate * (timeHelper.time() - start_time)
            e = np.array([np.cos(angle), np.sin(angle), 0.0])
            pos, vel = RADIUS * e + [0, 0, HEIGHT], RADIUS * rate * np.array([-e[1], e[0], 0.0])
            cf.cmdFullState(pos, vel, -RADIUS * rate**2 * e, yaw=0.0, omega=[0.0, 0.0, 0.0])
            errors.append(np.linalg.norm(cf.position() - pos))
        timeHelper.sleepForRate(50)

    for cf in allcfs.crazyflies:
        cf.notifySetpointsStop()
    allcfs.land(targetHeight=0.02, duration=2.0)
    timeHelper.sleep(2.5)
    print(
        f"largest error on the circle {max(errors):.3f} m, heights after landing "
        f"{[round(float(cf.position()[2]), 3) for cf in allcfs.crazyflies]} m"
    )
    return max(errors), [float(cf.position()[2]) for cf in allcfs.crazyflies]


if __name__ == "__main__":
    main()
