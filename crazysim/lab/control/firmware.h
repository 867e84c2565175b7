/* Interface of controllers in C for crazysim.control.CFirmware.
 *
 * Include this file in one source file of a library, define the three functions below, and compile with
 *
 *     cc -O2 -shared -fPIC -I FOLDER my_controller.c -o my_controller.so
 *
 * where `python -c "from crazysim.control import CFirmware; print(CFirmware.include)"` prints FOLDER. One library controls
 * any number of drones, so everything that it stores about a drone must be in the memory of that drone.
 */
#ifndef CRAZYSIM_FIRMWARE_H
#define CRAZYSIM_FIRMWARE_H

#include <stddef.h>

#define CRAZYSIM_FIRMWARE_VERSION 1

#ifdef __cplusplus
extern "C" {
#endif

/* Level of the command. */
enum crazysim_level {
  CRAZYSIM_STATE = 0,     /* setpoint: position, m, velocity, m/s, acceleration, m/s^2, quaternion xyzw, rates, rad/s */
  CRAZYSIM_ATTITUDE = 1,  /* roll, pitch, yaw, rad, collective thrust, N */
  CRAZYSIM_BODY_RATE = 2, /* body rates, rad/s, collective thrust, N */
};

/* Input of a controller at each call. */
struct crazysim_input {
  float time;           /* time since the reset of the world, s */
  float dt;             /* time from one call to the next, s */
  float pos[3];         /* position, world frame, m */
  float quat[4];        /* attitude, body to world, xyzw, 1 */
  float vel[3];         /* velocity, world frame, m/s */
  float ang_vel[3];     /* angular velocity, body frame, rad/s */
  float command[16];    /* command in force; 4 numbers at the levels below CRAZYSIM_STATE, then zeros */
  float feedforward[8]; /* jerk, m/s^3, snap, m/s^4, yaw rate, rad/s, yaw acceleration, rad/s^2, of a setpoint */
};

/* Return the size of the memory of one drone, bytes. */
size_t crazysim_memory_size(void);

/* Initialise the memory of a drone at rest; all of its bytes are zero before the call. */
void crazysim_init(void *memory);

/* Write the motor commands of one drone, in the order of the airframe's rotors, in the unit of CFirmware.motors. */
void crazysim_update(void *memory, enum crazysim_level level, const struct crazysim_input *input, float *motors);

/* Write the motor commands of `n` drones with memories `stride` bytes apart. crazysim calls this function. */
#if defined(__GNUC__)
__attribute__((visibility("default")))
#endif
void crazysim_update_all(int n, int n_motors, size_t stride, char *memories, int level,
                         const struct crazysim_input *inputs, float *motors) {
  for (int i = 0; i < n; ++i)
    crazysim_update(memories + stride * i, (enum crazysim_level)level, inputs + i, motors + n_motors * i);
}

#if defined(__GNUC__)
__attribute__((visibility("default")))
#endif
int crazysim_version(void) { return CRAZYSIM_FIRMWARE_VERSION; }

#ifdef __cplusplus
}
#endif
#endif
