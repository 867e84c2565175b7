/* The Crazyflie firmware's controllers Mellinger and Lee for crazysim.control.CFirmware.
 *
 * They keep what they remember in a struct, so one library flies any number of drones. The files are those that
 * Bitcraze's Python module cffirmware is made of. FIRMWARE is a clone of github.com/bitcraze/crazyflie-firmware, and
 * FOLDER is as in firmware.h; for the other controller replace Mellinger by Lee, and mellinger by lee:
 *
 *     touch autoconf.h
 *     cc -O2 -shared -fPIC -w -DUNIT_TEST_MODE -DCONTROLLER=Mellinger -I . -I FOLDER -I FIRMWARE/src/config \
 *         $(find FIRMWARE/src -type d \( -name interface -o -path "*interface*" \) | sed 's/^/-I /') \
 *         crazyflie.c FIRMWARE/src/modules/src/controller/controller_mellinger.c \
 *         FIRMWARE/src/modules/src/power_distribution_quadrotor.c -lm -o mellinger.so
 *
 * Rotors are those of the airframe cf2x_L250.
 */
#include <string.h>

#include "firmware.h"
#include "math3d.h"
#include "controller_lee.h"
#include "controller_mellinger.h"
#include "power_distribution.h"

#define JOIN_(a, b, c) a##b##c
#define JOIN(a, b, c) JOIN_(a, b, c)
#define MEMORY JOIN(controller, CONTROLLER, _t)

static const float degree = 57.29577951f;

size_t crazysim_memory_size(void) { return sizeof(MEMORY); }

void crazysim_init(void *memory) { JOIN(controller, CONTROLLER, Init)(memory); }

void crazysim_update(void *memory, enum crazysim_level level, const struct crazysim_input *in, float *motors) {
  setpoint_t setpoint;
  sensorData_t sensors;
  state_t state;
  control_t control;
  motors_thrust_uncapped_t thrusts;
  motors_thrust_pwm_t limited;
  memset(&setpoint, 0, sizeof setpoint);
  memset(&sensors, 0, sizeof sensors);
  memset(&state, 0, sizeof state);
  memset(&control, 0, sizeof control);
  (void)level; /* CRAZYSIM_STATE */

  const float *c = in->command;
  setpoint.mode.x = setpoint.mode.y = setpoint.mode.z = setpoint.mode.quat = modeAbs;
  setpoint.position = (point_t){.x = c[0], .y = c[1], .z = c[2]};
  setpoint.velocity = (velocity_t){.x = c[3], .y = c[4], .z = c[5]};
  setpoint.acceleration = (acc_t){.x = c[6], .y = c[7], .z = c[8]};
  setpoint.attitudeQuaternion = (quaternion_t){.x = c[9], .y = c[10], .z = c[11], .w = c[12]};
  setpoint.attitudeRate = (attitude_t){.roll = degree * c[13], .pitch = degree * c[14], .yaw = degree * c[15]};
  state.position = (point_t){.x = in->pos[0], .y = in->pos[1], .z = in->pos[2]};
  state.velocity = (velocity_t){.x = in->vel[0], .y = in->vel[1], .z = in->vel[2]};
  state.attitudeQuaternion =
      (quaternion_t){.x = in->quat[0], .y = in->quat[1], .z = in->quat[2], .w = in->quat[3]};
  sensors.gyro.x = degree * in->ang_vel[0];
  sensors.gyro.y = degree * in->ang_vel[1];
  sensors.gyro.z = degree * in->ang_vel[2];

  JOIN(controller, CONTROLLER, )(memory, &control, &setpoint, &sensors, &state, 0);

  powerDistribution(&control, &thrusts);
  powerDistributionCap(&thrusts, &limited);
  for (int i = 0; i < 4; ++i) motors[i] = limited.list[i] / 65535.0f;
}
