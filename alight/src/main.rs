//! Lands a UAV on a printed marker.
fn main() {}
