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

/// Refuses a pattern with another word in braces than those that are replaced.
///
/// # Errors
/// As a sentence that names the word and the known ones.
pub(crate) fn check_placeholders(pattern: &Path) -> Result<(), String> {
    let text = pattern.to_string_lossy();
    let words = text.split('{').skip(1).filter_map(|rest| Some(rest.split_once('}')?.0));
    match words.into_iter().find(|word| *word != "time") {
        None => Ok(()),
        Some(word) => Err(format!(
            "`{{{word}}}` is not a placeholder; the only one is `{{time}}`, the time at which the file begins (UTC)"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_placeholders_are_refused_by_name() {
        let check = |pattern: &str| check_placeholders(Path::new(pattern));
        for known in ["a/b.mcap", "{time}.mcap", "f {time} {time}", "a{b", "a}b{"] {
            assert_eq!(check(known), Ok(()), "{known}");
        }
        let error = check("f {time} {foo}.mcap").unwrap_err();
        assert!(error.contains("`{foo}`") && error.contains("`{time}`"), "{error}");
    }

    #[test]
    fn the_time_in_a_name_is_utc() {
        let at = |utc_s: i64| named(Path::new("a-{time}.mcap"), utc_s * 1_000_000_000);
        assert_eq!(at(0), Path::new("a-19700101T000000Z.mcap"));
        assert_eq!(at(951_782_400), Path::new("a-20000229T000000Z.mcap"));
        assert_eq!(at(1_795_344_611), Path::new("a-20261122T105011Z.mcap"));
        assert_eq!(at(-1), at(0));
    }
}
