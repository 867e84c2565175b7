"""Estimators beyond the Crazyflie's Kalman filter: one for any airframe and sensor, and the complementary filter."""
