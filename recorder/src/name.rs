//! The names of recordings.

use std::path::{Path, PathBuf};

/// The pattern with a time for `{time}`: year, month, day, `T`, hour, minute, second, `Z` for UTC.
pub(crate) fn named(pattern: &Path, utc_ns: i64) -> PathBuf {
    let time = utc(utc_ns.div_euclid(1_000_000_000));
    PathBuf::from(pattern.to_string_lossy().replace("{time}", &time))
}

/// A time in seconds since 1970 as text. The calendar is H. Hinnant's `civil_from_days`.
fn utc(seconds: i64) -> String {
    let (days, second) = (seconds.div_euclid(86_400), seconds.rem_euclid(86_400));
    let shifted = days + 719_468;
    let (era, of_era) = (shifted.div_euclid(146_097), shifted.rem_euclid(146_097));
    let year_of_era = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let day_of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted_month = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted_month + 2) / 5 + 1;
    let month = if shifted_month < 10 { shifted_month + 3 } else { shifted_month - 9 };
    let year = year_of_era + era * 400 + i64::from(month <= 2);
    let (hour, minute, second) = (second / 3600, second / 60 % 60, second % 60);
    format!("{year:04}{month:02}{day:02}T{hour:02}{minute:02}{second:02}Z")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_those_of_the_calendar() {
        assert_eq!(utc(0), "19700101T000000Z");
        assert_eq!(utc(951_782_400), "20000229T000000Z");
        assert_eq!(utc(1_795_344_611), "20261122T104651Z");
        assert_eq!(named(Path::new("a-{time}.mcap"), 0), Path::new("a-19700101T000000Z.mcap"));
    }
}
