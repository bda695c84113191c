//! A world with wind, a pad, a vehicle, an autopilot and a camera in it.
