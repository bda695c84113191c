//! Reads the host's clock: monotonic, the same for all processes of a host since its boot.

use std::sync::OnceLock;

/// Nanoseconds of the host's monotonic clock.
pub fn now_ns() -> i64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    time.tv_sec.saturating_mul(1_000_000_000).saturating_add(time.tv_nsec)
}

/// By how many nanoseconds the clock that counts on while the host sleeps (CLOCK_BOOTTIME) is ahead of [`now_ns`].
pub fn boot_ahead_ns() -> i64 {
    let boot = rustix::time::clock_gettime(rustix::time::ClockId::Boottime);
    let boot_ns = boot.tv_sec.saturating_mul(1_000_000_000).saturating_add(boot.tv_nsec);
    let ahead_ns = boot_ns.saturating_sub(now_ns());
    // A host that has not slept has one clock; the time between the two calls is no difference.
    if ahead_ns.abs() < 1_000_000 { 0 } else { ahead_ns }
}

/// The name of the clock of [`now_ns`]. Stamps of clocks with the same name are comparable.
pub fn clock_name() -> &'static str {
    static NAME: OnceLock<String> = OnceLock::new();
    NAME.get_or_init(|| {
        let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
        match boot.trim().get(..8) {
            Some(boot) => format!("monotonic/{boot}"),
            None => format!("monotonic/{}", host_name()),
        }
    })
}

/// The name of this host.
pub fn host_name() -> String {
    rustix::system::uname().nodename().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    #[test]
    fn time_increases_on_a_named_clock() {
        let before = super::now_ns();
        assert!(super::now_ns() >= before && before > 0);
        assert!(super::clock_name().len() > "monotonic/".len());
        assert!(super::boot_ahead_ns() >= 0);
    }
}
