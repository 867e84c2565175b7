"""Tasks that lead through hoops in their order, and past points in any order."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from crazysim.core.plugin import state
from crazysim.engine.stage import Stage, vmap_worlds
from crazysim.envs import HoopTask, ProgressTask, VisitTask, flying, make, state_of
from crazysim.envs.tasks.goals import OutcomeTask


class Watched:
    """What these tasks share: nothing is rewarded, and no episode ends."""

    def spawn(self, data, key):
        return flying(data, jnp.array([0.0, 0.0, 1.0]))

    def observe(self, data):
        return state_of(data)

    def rewards(self, data, action, last_action):
        return {"progress": self.progress(data)}

    def terminated(self, data):
        return jnp.zeros((), bool)


class Corner(Watched, HoopTask):
    """Through a hoop along x, then through one along y."""

    name = "corner"
    n_waypoints = 2

    def spawn(self, data, key):
        hoops = jnp.array([[[0.0, 0.0, 1.0], [1.0, 1.0, 1.0]]])
        return self.set_course(
            super().spawn(data, key), hoops, jnp.array([1.0, 2.0, 1.0]), jnp.array([0.0, jnp.pi / 2])
        )


class Four(Watched, VisitTask):
    """Past four points."""

    name = "four"
    n_waypoints = 4
    tolerance: float = 0.1

    def spawn(self, data, key):
        points = jnp.array([[[1.0, 0.0, 1.0], [2.0, 0.0, 1.0], [3.0, 0.0, 1.0], [4.0, 0.0, 1.0]]])
        return self.write(super().spawn(data, key), waypoints=points)


def follow(task, paths):
    """Return environment and data after drones, one per path, have been at the points of their paths, m."""
    env = make(task, n_worlds=len(paths), engine="interpret")
    data, judge = env.reset(jax.random.key(0)).data, Stage(task.after_substep, "drone")
    for pos in np.swapaxes(np.asarray(paths, np.float32), 0, 1):
        data = judge(data.replace(states=data.states.replace(pos=jnp.asarray(pos)[:, None])))
    return data


def test_hoops_are_passed_in_their_order_along_their_axes():
    through, before = [0.05, 0.3, 1.0], [-0.1, 0.0, 1.0]
    paths = [
        [before, through, [1.3, 0.9, 1.2]],  # the first
        [before, through, [1.3, 1.1, 1.2]],  # both
        [before, through, [1.3, 1.1, 1.5]],  # past the second, above
        [before, [0.05, 0.6, 1.0], through],  # past the first, on the left
        [before, [-0.1, 1.1, 1.0], [-0.1, 2.0, 1.0]],  # none: the second is not the next one
    ]
    data = follow(Corner(), paths)
    course = data.plugins["task"]
    np.testing.assert_array_equal(course.passed[:2, 0], [[True, False], [True, True]])
    np.testing.assert_array_equal(course.missed[:, 0], [False, False, True, True, False])
    assert not course.passed[4].any()
    legs = [np.linalg.norm([1.0 - 1.3, 0.1, -0.2]) + 1.0, np.linalg.norm([0.3, 0.9, 0.2])]
    np.testing.assert_allclose(vmap_worlds(Corner().error)(data)[:2, 0], legs, rtol=1e-5)
    np.testing.assert_allclose(vmap_worlds(Corner().ways)(data)[1, 0], [[0] * 3, [0] * 3, [-0.3, 0.9, -0.2]], atol=1e-6)
    rings = vmap_worlds(Corner().rings)(data)[0]
    np.testing.assert_allclose(rings, [[0, 0, 1, 1, 0, 0, 0.5], [1, 1, 1, 0, 1, 0, 0.5]], atol=1e-6)


def test_a_hoop_that_becomes_the_next_behind_the_drone_is_not_missed():
    inside_both_planes, round_it = [0.05, 1.2, 1.0], [1.0, 0.9, 1.0]
    paths = [[[-0.1, 1.2, 1.0], inside_both_planes, x, [1.0, 1.1, 1.0]] for x in ([1.0, 1.3, 1.0], round_it)]
    course = follow(Corner(radius=1.5), paths).plugins["task"]
    np.testing.assert_array_equal(course.passed[:, 0], [[True, False], [True, True]])
    assert not course.missed.any()


def test_points_are_visited_in_any_order():
    data = follow(Four(), [[[3.0, 0.0, 1.05], [1.0, 0.05, 1.0]], [[2.0, 0.2, 1.0], [0.0, 0.0, 1.0]]])
    np.testing.assert_array_equal(data.plugins["task"].passed[:, 0], [[True, False, True, False], [False] * 4])
    task = vmap_worlds(lambda data: (Four().error(data), Four().remaining_way(data), Four().target(data)))
    error, left, marks = task(data)
    np.testing.assert_allclose(error[:, 0], [np.hypot(1.0, 0.05) + 2, 1.0 + 4], rtol=1e-5)
    np.testing.assert_array_equal(left[:, 0], [2, 4])
    np.testing.assert_array_equal(np.isnan(marks[0, 0]).any(-1), [True, False, True, False])
    all_points = follow(Four(), [[[k, 0.0, 1.0] for k in (4.0, 1.0, 3.0, 2.0)]])
    assert vmap_worlds(Four().succeeded)(all_points).all()
    assert vmap_worlds(Four().error)(all_points) == 0.0


def test_a_task_with_several_bases_has_the_states_of_all():
    class Both(ProgressTask, OutcomeTask):
        further: jax.Array = state(())

    class Neither(ProgressTask, OutcomeTask):
        pass

    for task, names in ((Both, {"remaining_way_before", "success", "further"}), (Neither, {"failure"})):
        assert names | {"remaining_way_before"} <= {f.name for f in dataclasses.fields(task.Record)}
