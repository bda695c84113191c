//! Makes the names of recordings.

use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// The pattern with a time for `{time}`: year, month, day, `T`, hour, minute, second, `Z` for UTC.
pub(crate) fn named(pattern: &Path, utc_ns: i64) -> PathBuf {
    let since_1970 = Duration::from_nanos(u64::try_from(utc_ns).unwrap_or(0));
    // Past the year 9999, which no time in nanoseconds reaches, it would be an error.
    let time = humantime::format_rfc3339_seconds(SystemTime::UNIX_EPOCH + since_1970).to_string();
    PathBuf::from(pattern.to_string_lossy().replace("{time}", &time.replace(['-', ':'], "")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_in_a_name_is_utc() {
        let at = |utc_s: i64| named(Path::new("a-{time}.mcap"), utc_s * 1_000_000_000);
        assert_eq!(at(0), Path::new("a-19700101T000000Z.mcap"));
        assert_eq!(at(951_782_400), Path::new("a-20000229T000000Z.mcap"));
        assert_eq!(at(1_795_344_611), Path::new("a-20261122T105011Z.mcap"));
        assert_eq!(at(-1), at(0));
    }
}
