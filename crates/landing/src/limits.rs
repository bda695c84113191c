//! The macro that declares a section of the lander's settings with each default and range, and the error that
//! names a key out of range.

use std::fmt;
use std::ops::RangeInclusive;

/// A setting that cannot be used.
#[derive(Clone, Debug, PartialEq)]
pub struct ConfigError {
    /// The key, with dots, as in `phases.hold_timeout_s`.
    pub key: &'static str,
    /// The value to which it was set.
    pub value: f64,
    /// The smallest value allowed.
    pub min: f64,
    /// The largest value allowed.
    pub max: f64,
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} is {}, must lie between {} and {}", self.key, self.value, self.min, self.max)
    }
}

impl std::error::Error for ConfigError {}

/// Refuses a value outside its range; NaN lies outside every range.
pub(crate) fn check(
    key: &'static str,
    value: f64,
    range: RangeInclusive<f64>,
) -> Result<(), ConfigError> {
    if range.contains(&value) {
        return Ok(());
    }
    Err(ConfigError { key, value, min: *range.start(), max: *range.end() })
}

/// Declares the struct of a configuration section: `key: type = default` and, where the key has one, `,
/// range`. The struct deserializes as the section, has the defaults, and its `validate` names the first key
/// out of range.
macro_rules! settings {
    (
        $(#[$doc:meta])*
        $name:ident in $section:literal {
            $($(#[$key_doc:meta])* $key:ident: $type:ty = $default:expr $(, $range:expr)?;)*
        }
    ) => {
        $(#[$doc])*
        #[derive(Copy, Clone, Debug, PartialEq, Deserialize, Serialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            $(
                $(#[$key_doc])*
                $(#[doc = concat!(" Range: `", stringify!($range), "`.")])?
                pub $key: $type,
            )*
        }

        impl Default for $name {
            fn default() -> Self {
                Self { $($key: $default,)* }
            }
        }

        impl $name {
            pub(crate) fn validate(&self) -> Result<(), ConfigError> {
                $($(
                    check(concat!($section, ".", stringify!($key)), f64::from(self.$key), $range)?;
                )?)*
                Ok(())
            }
        }
    };
}
pub(crate) use settings;
