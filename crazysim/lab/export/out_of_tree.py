"""Export of policies as out of tree controllers of the Crazyflie's firmware (``controllerOutOfTree``).

The firmware calls such a controller in place of its own. The same C file is a library for
``crazysim.control.CFirmware``, which flies it in the simulator.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import crazysim
from crazysim.control import Control
from crazysim.core.settings import positive_integer
from crazysim.drones import Airframe
from crazysim.errors import require, require_type
from crazysim.lab.export.policies import POLICY_REMEDY, float_literal, to_c
from crazysim.lab.export.rl_tools import MAX_DIFFERENCE, MAX_VELOCITY, RAPTOR_RATE, raptor_order, weights_to_c
from crazysim.storage import as_path, write_file
from crazysim.train.interface import Interface
from crazysim.train.networks import Policy

HEADER_FILE, SOURCE_FILE = "policy.h", "controller.c"
"""Names of the exported files."""
MAIN_LOOP_RATE = 1000
"""Rate at which the firmware calls its controller, Hz (``RATE_MAIN_LOOP`` in ``stabilizer_types.h``)."""
OBSERVATION_FIELDS = {
    "pos": ("pos[{i}]", 3),
    "rot": ("rot[{i}]", 9),
    "quat": ("quat[{i}]", 4),
    "vel": ("vel[{i}]", 3),
    "ang_vel": ("ang_vel[{i}]", 3),
    "difference_to_goal": ("goal[{i}] - pos[{i}]", 3),
}
"""C expression and size, by name, of the observations that follow from a drone's state and its goal."""
RAPTOR_FIELDS = {
    "pos": (f"limited(pos[{{i}}] - goal[{{i}}], {MAX_DIFFERENCE}f)", 3),
    "rot": OBSERVATION_FIELDS["rot"],
    "vel": (f"limited(vel[{{i}}], {MAX_VELOCITY}f)", 3),
    "ang_vel": OBSERVATION_FIELDS["ang_vel"],
    "previous_action": ("memory->previous[{i}]", 4),
}
"""The same for a policy of RAPTOR's shape, in its order and with the limits of ``mc_raptor``."""


class Controller(NamedTuple):
    """What a C file needs to know of a policy in a header."""

    fields: Mapping[str, tuple[str, int]]
    """C expression and size of each observation, in order."""
    level: Control
    """Command level."""
    ranges: Sequence[tuple[float, float]]
    """Command at a zero action, and its change per unit of action."""
    components: Sequence[int]
    """Component of the command that each action sets."""
    has_memory: bool
    """Whether the policy keeps a memory between steps."""
    freq: int
    """Rate of the policy, Hz."""


def to_out_of_tree(
    policy: Policy | Mapping[str, np.ndarray],
    folder: str | Path,
    meta: Mapping[str, Any] | None,
    airframe: Airframe,
    freq: int = RAPTOR_RATE,
) -> tuple[Path, Path]:
    """Write a policy as an out of tree controller of the Crazyflie's firmware.

    The goal of the policy is the position of the firmware's setpoint, so that the high-level commander and position
    setpoints move it. Attitudes and body rates are passed on to the firmware's PID controller, and wrenches and rotor
    speeds to its mixer. The motors are off without a position setpoint, and while an observation is NaN or infinite.

    Args:
        policy: A trained policy, or weights of RAPTOR's shape, from ``read_rl_tools``.
        folder: Existing folder for ``policy.h`` and ``controller.c``.
        meta: Description of its inputs and outputs, from ``describe(env)`` or from ``load_policy``; None for weights.
        airframe: The drone, which provides the thrust curve and the largest thrust of the rotors.
        freq: Rate of the policy, a divisor of 1000 Hz.
    """
    freq = positive_integer("freq", freq)
    require(
        MAIN_LOOP_RATE % freq == 0,
        f"expected a rate that divides the firmware's {MAIN_LOOP_RATE} Hz, got {freq} Hz. Train with a divisor as "
        f"freq.",
    )
    header, source = as_path(folder) / HEADER_FILE, as_path(folder) / SOURCE_FILE
    controller = write_header(policy, header, meta, airframe, freq)
    write_file(source, "\n".join(_source_lines(controller, airframe)) + "\n")
    return header, source


def write_header(policy: Any, path: Path, meta: Any, airframe: Airframe, freq: int) -> Controller:
    """Write the policy as a C header, and return what its caller needs to know.

    Raises:
        ConfigError: If it observes more than the state and the goal of a drone.
    """
    if not isinstance(policy, Mapping):
        require_type(policy, Policy, POLICY_REMEDY)
    require_type(airframe, Airframe, "Use sim.airframes[0], or load_airframe(name).")
    if isinstance(policy, Mapping):
        order = raptor_order(airframe)
        weights_to_c(policy, path)
        half = float(np.max(airframe.rotor_vel_limits[1])) / 2
        return Controller(RAPTOR_FIELDS, Control.rotor_vel, [(half, half)] * 4, order, True, freq)
    interface = Interface.read(meta)
    require(
        interface.freq in (None, freq),
        f"expected the rate of the training, {interface.freq} Hz, got {freq} Hz. Use freq=meta['freq'].",
    )
    sizes = interface.sizes
    unknown = [name for name, size in sizes.items() if OBSERVATION_FIELDS.get(name, ("", 0))[1] != size]
    require(
        not unknown,
        f"expected observations of a drone's state and its goal, {', '.join(OBSERVATION_FIELDS)}, got "
        f"{', '.join(unknown)}. Use the export as C, and compute the others in your controller.",
    )
    level = Control(interface.level)
    require(
        level != Control.state,
        "expected a policy that commands attitudes or a lower level, got one of positions. Fly it over the radio "
        "with fly_policy.",
    )
    require(
        level != Control.rotor_vel or len(interface.ranges) == 4,
        f"expected four rotors, got {len(interface.ranges)}. Use a quadrotor.",
    )
    to_c(policy, path, meta)
    fields = {name: OBSERVATION_FIELDS[name] for name in sorted(sizes)}
    return Controller(fields, level, interface.ranges, range(len(interface.ranges)), policy.has_memory, freq)


def command_lines(controller: Controller) -> Iterator[str]:
    """Yield the C function ``policy_command`` from the state and the goal of a drone to the policy's command."""
    fields, n = controller.fields, len(controller.ranges)
    if controller.has_memory:
        yield f"""/* What a drone remembers between steps. */
struct policy_memory {{ policy_state state; float previous[{n}]; }};

static void policy_start(struct policy_memory *memory)
{{
    memset(memory, 0, sizeof *memory);
    policy_reset(&memory->state);
}}
"""
    if fields is RAPTOR_FIELDS:
        yield "static float limited(float x, float limit) \n"
        yield "{ return !isfinite(x) || (-limit < x && x < limit) ? x : (x < 0 ? -limit : limit); }\n"
    memory = "struct policy_memory *memory, " if controller.has_memory else ""
    yield f"""/* Writes the {controller.level.value} command of the policy.
 *
 * Returns false, and writes nothing, if an observation is not finite.
 *
 * pos, vel, goal: world frame, m, m/s; quat: body to world, xyzw; ang_vel: body frame, x forward, y left, z up, rad/s.
 */
static bool policy_command({memory}const float pos[3], const float quat[4], const float vel[3],
                           const float ang_vel[3], const float goal[3], float command[{n}])
{{"""
    if "rot" in fields:
        yield """    const float x = quat[0], y = quat[1], z = quat[2], w = quat[3];
    const float rot[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                          2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                          2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};"""
    expressions = "".join(expression for expression, _ in fields.values())
    for name in ("pos", "quat", "vel", "ang_vel", "goal"):
        if not re.search(rf"\b{name}\[", expressions) and not (name == "quat" and "rot" in fields):
            yield f"    (void){name};"
    values = [expression.format(i=i) for expression, size in fields.values() for i in range(size)]
    yield f"    const float observation[{len(values)}] = {{"
    yield from (f"        {value}," for value in values)
    yield "    };"
    yield f"    for (int i = 0; i < {len(values)}; ++i)"
    yield "        if (!isfinite(observation[i])) return false;"
    yield f"    float action[{n}];"
    yield f"    policy({'&memory->state, ' if controller.has_memory else ''}observation, action);"
    if controller.has_memory:
        yield "    memcpy(memory->previous, action, sizeof action);"
    # Command from the action.
    for i, (k, (centre, scale)) in enumerate(zip(controller.components, controller.ranges, strict=True)):
        yield f"    command[{k}] = {float_literal(centre)} + {float_literal(scale)} * action[{i}];"
    yield "    return true;"
    yield "}"


def _source_lines(controller: Controller, airframe: Airframe) -> Iterator[str]:
    level, freq, memory = controller.level, controller.freq, controller.has_memory
    yield f"""/* Out of tree controller generated by crazysim {crazysim.__version__} for {airframe.name}; do not edit.
 *
 * For the firmware put this file and {HEADER_FILE} into the src folder of an app with CONFIG_CONTROLLER_OOT=y, and set
 * the parameter stabilizer.controller to the out of tree controller. The policy acts at {freq} Hz. The motors are off
 * without a position setpoint, and while an observation is NaN or infinite.{_usage_text(level, freq)}
 */
#include <math.h>
#include <stdbool.h>
#include <string.h>

#include "{HEADER_FILE}"
"""
    yield from command_lines(controller)
    # Functions that the firmware calls.
    argument = "memory, " if memory else ""
    if level == Control.rotor_vel:
        yield CFIRMWARE_SOURCE.format(
            size="sizeof(struct policy_memory)" if memory else "0",
            start="policy_start(memory);" if memory else "(void)memory;",
            argument=argument,
        )
    needs_pid = level in (Control.attitude, Control.body_rate)
    yield OUT_OF_TREE_SOURCE.format(
        period=MAIN_LOOP_RATE // freq,
        n=len(controller.ranges),
        include='\n#include "controller_pid.h"' if needs_pid else "",
        memory="\nstatic struct policy_memory memory;" if memory else "",
        start="\n        if (!flying) policy_start(&memory);" if memory else "",
        argument="&memory, " if memory else "",
        init="controllerPidInit();" if needs_pid else "",
        test="controllerPidTest()" if needs_pid else "true",
        off=_stop_statements(level),
        output=_output_statements(level, airframe).strip("\n"),
    ) + ("\n#endif" if level == Control.rotor_vel else "")


def _usage_text(level: Control, freq: int) -> str:
    if level != Control.rotor_vel:
        return ""
    return f"""
 * In crazysim, compile it with -DCRAZYSIM as firmware.h says, and use
 * Sim(control="state", controller=CFirmware(library, motors="rpm", freq={freq}))."""


CFIRMWARE_SOURCE = """
#ifdef CRAZYSIM
#include "firmware.h"

size_t crazysim_memory_size(void) {{ return {size}; }}

void crazysim_init(void *memory) {{ {start} }}

void crazysim_update(void *memory, enum crazysim_level level, const struct crazysim_input *in, float *motors)
{{
    (void)memory;
    (void)level; /* CRAZYSIM_STATE */
    if (!policy_command({argument}in->pos, in->quat, in->vel, in->ang_vel, in->command, motors))
        memset(motors, 0, 4 * sizeof *motors);
}}

#else"""
"""C source of the interface of ``CFirmware``."""

OUT_OF_TREE_SOURCE = """
#include "controller.h"{include}

static const float degree = 57.2957795f;
static float command[{n}];{memory}
static bool flying = false; /* the policy has commanded since the motors were last off */

void controllerOutOfTreeInit(void)
{{
    memset(command, 0, sizeof command);
    flying = false;
    {init}
}}

bool controllerOutOfTreeTest(void) {{ return {test}; }}

void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
                         const state_t *state, const stabilizerStep_t stabilizerStep)
{{
    const bool has_goal = setpoint->mode.x == modeAbs && setpoint->mode.y == modeAbs && setpoint->mode.z == modeAbs;
    if (has_goal && (!flying || stabilizerStep % {period} == 0)) {{{start}
        const float pos[3] = {{state->position.x, state->position.y, state->position.z}};
        const float quat[4] = {{state->attitudeQuaternion.x, state->attitudeQuaternion.y, state->attitudeQuaternion.z,
                               state->attitudeQuaternion.w}};
        const float vel[3] = {{state->velocity.x, state->velocity.y, state->velocity.z}};
        const float ang_vel[3] = {{sensors->gyro.x / degree, sensors->gyro.y / degree, sensors->gyro.z / degree}};
        const float goal[3] = {{setpoint->position.x, setpoint->position.y, setpoint->position.z}};
        flying = policy_command({argument}pos, quat, vel, ang_vel, goal, command);
    }}
    if (!has_goal || !flying) {{
        {off}
        flying = false;
        return;
    }}
{output}
}}"""
"""C source of the three functions of the firmware's interface."""


def _stop_statements(level: Control) -> str:
    mode = {Control.rotor_vel: "controlModeForce", Control.force_torque: "controlModeForceTorque"}
    return (
        f"memset(control, 0, sizeof *control);\n        control->controlMode = {mode.get(level, 'controlModeLegacy')};"
    )


def _output_statements(level: Control, airframe: Airframe) -> str:
    max_thrust = float(np.max(airframe.value("rotors.thrust_max")))
    if level == Control.force_torque:
        return """
    control->controlMode = controlModeForceTorque;
    control->thrustSi = command[0] > 0 ? command[0] : 0;
    control->torqueX = command[1];
    control->torqueY = command[2];
    control->torqueZ = command[3];"""
    if level == Control.rotor_vel:
        k0, k1, k2 = (float_literal(x / max_thrust) for x in airframe.value("rotors.thrust_curve", (3,)))
        return f"""
    control->controlMode = controlModeForce;
    for (int i = 0; i < 4; ++i) {{ /* thrust over its maximum, from the speed, rpm */
        const float speed = command[i];
        const float fraction = {k0} + speed * ({k1} + speed * {k2});
        control->normalizedForces[i] = speed > 0 && fraction > 0 ? (fraction < 1 ? fraction : 1) : 0;
    }}"""
    if level == Control.attitude:
        mode, fields = "modeAbs", "attitude"
    else:
        mode, fields = "modeVelocity", "attitudeRate"
    return f"""
    setpoint_t inner_setpoint;
    memset(&inner_setpoint, 0, sizeof inner_setpoint);
    inner_setpoint.mode.roll = inner_setpoint.mode.pitch = inner_setpoint.mode.yaw = {mode};
    inner_setpoint.{fields}.roll = degree * command[0];
    inner_setpoint.{fields}.pitch = -degree * command[1]; /* the firmware's pitch is positive with the nose up */
    inner_setpoint.{fields}.yaw = degree * command[2];
    const float thrust = command[3] / {float_literal(airframe.n_rotors * max_thrust)}; /* of the largest */
    inner_setpoint.thrust = 65535 * (thrust > 0 ? (thrust < 1 ? thrust : 1) : 0);
    controllerPid(control, &inner_setpoint, sensors, state, stabilizerStep);"""
