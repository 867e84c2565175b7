/* An exported policy above the Crazyflie firmware's own PID controller, for crazysim.control.CFirmware.
 *
 * `crazysim export RUN --out-of-tree .` writes controller.c and policy.h. FIRMWARE is a clone of
 * github.com/bitcraze/crazyflie-firmware, and FOLDER is as in firmware.h. For the airframe cf21B_500:
 *
 *     touch autoconf.h
 *     cc -O2 -shared -fPIC -w -DUNIT_TEST_MODE -DCONFIG_CONTROLLER_OOT -DCONFIG_PLATFORM_CF21BL -I . -I FOLDER \
 *         -I FIRMWARE/src/config \
 *         $(find FIRMWARE/src -type d \( -name interface -o -path "*interface*" \) | sed 's/^/-I /') \
 *         out_of_tree.c controller.c \
 *         $(find FIRMWARE/src -name "*_pid*.c" -o -name pid.c -o -name num.c -o -name filter.c \
 *             -o -name power_distribution_quadrotor.c) -lm -o out_of_tree.so
 *
 * Use Sim(1, control="state", controller=CFirmware("out_of_tree.so", freq=1000), freq=1000). The PID controller has
 * global variables, so that one library flies one drone.
 */
#include <math.h>
#include <string.h>

#include "firmware.h"
#include "controller.h"
#include "power_distribution.h"

static const float degree = 57.29577951f;

size_t crazysim_memory_size(void) { return sizeof(control_t); }

void crazysim_init(void *memory) {
  memset(memory, 0, sizeof(control_t));
  controllerOutOfTreeInit();
}

void crazysim_update(void *memory, enum crazysim_level level, const struct crazysim_input *in, float *motors) {
  setpoint_t setpoint;
  sensorData_t sensors;
  state_t state;
  motors_thrust_uncapped_t thrusts;
  motors_thrust_pwm_t limited;
  memset(&setpoint, 0, sizeof setpoint);
  memset(&sensors, 0, sizeof sensors);
  memset(&state, 0, sizeof state);
  (void)level; /* CRAZYSIM_STATE */

  const float *c = in->command, *q = in->quat;
  setpoint.mode.x = setpoint.mode.y = setpoint.mode.z = modeAbs;
  setpoint.position = (point_t){.x = c[0], .y = c[1], .z = c[2]};
  state.position = (point_t){.x = in->pos[0], .y = in->pos[1], .z = in->pos[2]};
  state.velocity = (velocity_t){.x = in->vel[0], .y = in->vel[1], .z = in->vel[2]};
  state.attitudeQuaternion = (quaternion_t){.x = q[0], .y = q[1], .z = q[2], .w = q[3]};
  state.attitude.roll = degree * atan2f(2 * (q[3] * q[0] + q[1] * q[2]), 1 - 2 * (q[0] * q[0] + q[1] * q[1]));
  state.attitude.pitch = degree * asinf(fmaxf(-1.0f, fminf(1.0f, 2 * (q[2] * q[0] - q[3] * q[1])))); /* nose up */
  state.attitude.yaw = degree * atan2f(2 * (q[3] * q[2] + q[0] * q[1]), 1 - 2 * (q[1] * q[1] + q[2] * q[2]));
  sensors.gyro.x = degree * in->ang_vel[0];
  sensors.gyro.y = degree * in->ang_vel[1];
  sensors.gyro.z = degree * in->ang_vel[2];

  controllerOutOfTree(memory, &setpoint, &sensors, &state, (uint32_t)(1000 * in->time + 0.5f));

  powerDistribution(memory, &thrusts);
  powerDistributionCap(&thrusts, &limited);
  for (int i = 0; i < 4; ++i) motors[i] = limited.list[i] / 65535.0f;
}
