//! The landing decision, a pure function of time and events.
