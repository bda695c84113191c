//! Layered configuration: defaults, a user's file, and `key=value` settings.
//!
//! Each service ships a TOML file with every key, its default, and a comment with meaning, unit and range. A
//! user's file and single settings override it. An unknown key, a value of another type and a value out of
//! range are rejected with their source, the key, the value and the limit.

use std::fmt::Display;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::value::{Error as ValueError, StrDeserializer};
use serde::de::{DeserializeOwned, IntoDeserializer};
pub use toml::Table;
use toml::Value;
pub use toml::de::Error as TableError;

/// A service's configuration.
pub trait Settings: Sized {
    /// The TOML file with the defaults of all keys.
    const DEFAULTS: &'static str;

    /// The values of a table with every key: `table.try_into()`. Each service implements this, so that reading its configuration is
    /// compiled in its crate, and not again in every crate that loads it.
    ///
    /// # Errors
    /// When the table is of other settings.
    fn from_table(table: Table) -> Result<Self, TableError>;

    /// Checks the values' ranges.
    fn check(&self, check: &mut Check<'_>);
}

/// The settings of a user over the defaults.
#[derive(Clone, Debug, Default)]
pub struct Layers {
    /// A file.
    pub file: Option<PathBuf>,
    /// Settings `key=value` with dotted keys and TOML values; the quotes of a string may be omitted.
    pub set: Vec<String>,
}

/// Why a configuration was rejected.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// A file that cannot be read.
    #[error("reading the file {path:?}: {cause}; check the path")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        cause: std::io::Error,
    },
    /// A file whose bytes are no UTF-8.
    #[error("the file {path:?} is not UTF-8 in line {line}{hint}: save it as UTF-8")]
    NotUtf8 {
        /// The file.
        path: PathBuf,
        /// The line with the first wrong byte, from 1.
        line: usize,
        /// The encoding that it seems to have, or nothing.
        hint: &'static str,
    },
    /// Text that is not TOML.
    #[error("{source_name} is not valid TOML: {}", shown(cause))]
    Syntax {
        /// The file or setting.
        source_name: String,
        /// The parser's reason.
        cause: String,
    },
    /// A setting without `=`.
    #[error("the setting `{0}` is not of the form key=value; write `{0}=VALUE`", shown(text))]
    Form {
        /// The setting.
        text: String,
    },
    /// A key that does not exist.
    #[error("{source_name}: there is no key `{}`{hint}", shown(key))]
    UnknownKey {
        /// The file or setting.
        source_name: String,
        /// The key.
        key: String,
        /// A similar key, or nothing.
        hint: String,
    },
    /// A value of the wrong type.
    #[error("{source_name}: `{key}` = {} is {found}, where {wanted} is needed", shown(value))]
    WrongType {
        /// The file or setting.
        source_name: String,
        /// The key.
        key: String,
        /// The value.
        value: String,
        /// Its type.
        found: &'static str,
        /// The default's type.
        wanted: &'static str,
    },
    /// A value that the service rejects.
    #[error("{source_name}: `{key}` = {} is invalid: {}", shown(value), shown(limit))]
    Refused {
        /// The file or setting.
        source_name: String,
        /// The key.
        key: String,
        /// The value.
        value: String,
        /// The allowed values.
        limit: String,
    },
}

impl ConfigError {
    /// The same of a setting of several services, whose keys begin with the service's name.
    #[must_use]
    pub fn of_service(self, service: &str) -> Self {
        let source = |name: String| match name.strip_prefix("--set ") {
            Some(setting) => format!("--set {service}.{setting}"),
            None => name,
        };
        match self {
            Self::UnknownKey { source_name, key, hint } => Self::UnknownKey {
                source_name: source(source_name),
                key: format!("{service}.{key}"),
                hint: hint.replace("did you mean `", &format!("did you mean `{service}.")),
            },
            Self::WrongType { source_name, key, value, found, wanted } => Self::WrongType {
                source_name: source(source_name),
                key: format!("{service}.{key}"),
                value,
                found,
                wanted,
            },
            Self::Refused { source_name, key, value, limit } => Self::Refused {
                source_name: source(source_name),
                key: format!("{service}.{key}"),
                value,
                limit,
            },
            Self::Syntax { source_name, cause } => {
                Self::Syntax { source_name: source(source_name), cause }
            }
            Self::Form { text } => Self::Form { text: format!("{service}.{text}") },
            other @ (Self::Unreadable { .. } | Self::NotUtf8 { .. }) => other,
        }
    }
}

impl ConfigError {
    /// The same with a suggestion for an unknown key without a similar key in its table: a key of such a name in another table of
    /// `all`.
    fn with_place(self, all: &Table, layer: &Table) -> Self {
        match self {
            Self::UnknownKey { source_name, key, hint } if hint.is_empty() => {
                let is_meant = |path: &[&str]| {
                    let full_key = path.join(".");
                    full_key
                        .strip_prefix(&key)
                        .is_some_and(|it| it.is_empty() || it.starts_with('.'))
                };
                let set = single_values(layer).into_iter().map(|(path, _)| path);
                let name = set.filter(|path| is_meant(path)).find_map(|path| path.last().copied());
                let near = name.and_then(|name| elsewhere(all, name));
                let hint = near.map_or(hint, |near| format!("; did you mean `{near}`?"));
                Self::UnknownKey { source_name, key, hint }
            }
            other => other,
        }
    }
}

/// A configuration as values and as TOML.
#[derive(Clone, Debug)]
pub struct Effective<T> {
    /// The values.
    pub settings: T,
    /// The values as TOML.
    pub table: Table,
}

/// A layer with its name.
struct Layer {
    name: String,
    table: Table,
}

impl Layers {
    /// The configuration of a service under these layers.
    ///
    /// # Errors
    /// [`ConfigError`] names the layer, the key, the value and the limit.
    pub fn load<T: Settings>(&self) -> Result<Effective<T>, ConfigError> {
        let defaults = parse("the defaults", T::DEFAULTS)?;
        let table = defaults.clone();
        let mut layers = Vec::new();
        if let Some(path) = &self.file {
            layers.push(file_layer(path)?);
        }
        for text in &self.set {
            layers.push(setting_layer(text, &defaults)?);
        }
        effective(table, &layers)
    }
}

/// A configuration with one more setting `key=value`.
///
/// # Errors
/// As [`Layers::load`].
pub fn changed<T: Settings + Serialize>(current: &T, setting: &str) -> Result<T, ConfigError> {
    let table = Table::try_from(current).map_err(|cause| ConfigError::Syntax {
        source_name: "the configuration in use".to_owned(),
        cause: cause.to_string(),
    })?;
    let layer = setting_layer(setting, &table)?;
    Ok(effective(table, &[layer])?.settings)
}

/// A configuration as TOML, with every key.
pub fn to_toml<T: Serialize>(settings: &T) -> String {
    // A configuration is a table of values that TOML has.
    Table::try_from(settings).map(|table| table.to_string()).unwrap_or_default()
}

/// The configuration that TOML text from `name` makes of the defaults, with further settings `key=value`.
///
/// # Errors
/// As [`Layers::load`].
pub fn from_toml<T: Settings>(
    name: &str,
    text: &str,
    set: &[String],
) -> Result<Effective<T>, ConfigError> {
    let defaults = parse("the defaults", T::DEFAULTS)?;
    let mut layers = vec![Layer { name: name.to_owned(), table: parse(name, text)? }];
    for text in set {
        layers.push(setting_layer(text, &defaults)?);
    }
    effective(defaults, &layers)
}

/// The configuration that results from layers over a table.
fn effective<T: Settings>(mut table: Table, layers: &[Layer]) -> Result<Effective<T>, ConfigError> {
    let before = table.clone();
    for layer in layers {
        lay_over(&mut table, &layer.table, &layer.name, &mut String::new())
            .map_err(|problem| problem.with_place(&before, &layer.table))?;
    }
    let settings =
        T::from_table(table.clone()).map_err(|cause| refusal::<T>(before, layers, &cause))?;
    let mut check = Check { table: &table, layers, problem: None };
    settings.check(&mut check);
    match check.problem {
        Some(problem) => Err(problem),
        None => Ok(Effective { settings, table }),
    }
}

/// The value, and its layer, with which the settings cannot be read although [`lay_over`] found all keys and types right: such
/// as a word that an enumeration lacks. The reader of a table does not report its position, so each value is tried alone.
fn refusal<T: Settings>(mut table: Table, layers: &[Layer], cause: &TableError) -> ConfigError {
    for layer in layers {
        for (path, value) in single_values(&layer.table) {
            let key = path.join(".");
            let mut single = Table::new();
            if let Some((last, parents)) = path.split_last() {
                single.insert((*last).to_owned(), value.clone());
                for parent in parents.iter().rev() {
                    let inner = std::mem::take(&mut single);
                    single.insert((*parent).to_owned(), Value::Table(inner));
                }
            }
            if let Err(problem) = lay_over(&mut table, &single, &layer.name, &mut String::new()) {
                return problem;
            }
            if let Err(cause) = T::from_table(table.clone()) {
                return ConfigError::Refused {
                    source_name: layer.name.clone(),
                    key,
                    value: value.to_string(),
                    limit: cause.message().to_owned(),
                };
            }
        }
    }
    let source_name = layers.last().map_or("the defaults", |layer| &layer.name).to_owned();
    ConfigError::Syntax { source_name, cause: cause.message().to_owned() }
}

/// The values below a table that are no tables, with their paths.
fn single_values(table: &Table) -> Vec<(Vec<&str>, &Value)> {
    let mut values = Vec::new();
    for (name, value) in table {
        let Value::Table(inner) = value else {
            values.push((vec![name.as_str()], value));
            continue;
        };
        for (mut path, value) in single_values(inner) {
            path.insert(0, name);
            values.push((path, value));
        }
    }
    values
}

fn parse(name: &str, text: &str) -> Result<Table, ConfigError> {
    text.parse::<Table>().map_err(|cause| ConfigError::Syntax {
        source_name: name.to_owned(),
        cause: cause.to_string().trim_end().to_owned(),
    })
}

/// The text of a file with settings, or with a description that they name.
///
/// # Errors
/// When it cannot be read, or is not UTF-8.
pub fn read_text(path: impl AsRef<Path>) -> Result<String, ConfigError> {
    let path = path.as_ref();
    let bytes = std::fs::read(path)
        .map_err(|cause| ConfigError::Unreadable { path: path.to_owned(), cause })?;
    String::from_utf8(bytes).map_err(|wrong| {
        let before = wrong.as_bytes().get(..wrong.utf8_error().valid_up_to()).unwrap_or_default();
        let hint = match wrong.as_bytes() {
            [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => ", but UTF-16",
            _ => "",
        };
        let line = 1 + before.iter().filter(|byte| **byte == b'\n').count();
        ConfigError::NotUtf8 { path: path.to_owned(), line, hint }
    })
}

fn file_layer(path: &Path) -> Result<Layer, ConfigError> {
    let text = read_text(path)?;
    let name = path.display().to_string();
    let table = parse(&name, &text)?;
    Ok(Layer { name, table })
}

fn setting_layer(text: &str, defaults: &Table) -> Result<Layer, ConfigError> {
    let name = format!("--set {}", shown(text));
    let (key, value) =
        text.split_once('=').ok_or_else(|| ConfigError::Form { text: text.to_owned() })?;
    let (key, value) = (key.trim(), value.trim());
    // A word without quotes is a string where the default is one.
    let quoted = || parse(&name, &format!("{key} = {}", Value::String(value.to_owned())));
    let default = look_up(defaults, key);
    let default_is_text = matches!(default, Some(Value::String(_)));
    let table = match parse(&name, &format!("{key} = {value}")) {
        Ok(table) if default_is_text && !matches!(look_up(&table, key), Some(Value::String(_))) => {
            quoted()?
        }
        Ok(table) => table,
        // An unknown key is reported when the layers are merged, before its value.
        Err(_) if default_is_text || default.is_none() => quoted()?,
        Err(problem) => {
            return Err(match default {
                // For a list or a table the parser's error is more precise.
                None | Some(Value::Array(_) | Value::Table(_)) => problem,
                Some(default) => ConfigError::WrongType {
                    source_name: name,
                    key: key.to_owned(),
                    value: value.to_owned(),
                    found: "no value that TOML has",
                    wanted: kind(default),
                },
            });
        }
    };
    Ok(Layer { name, table })
}

fn look_up<'a>(table: &'a Table, dotted: &str) -> Option<&'a Value> {
    let (first, rest) = match dotted.split_once('.') {
        Some((first, rest)) => (first, Some(rest)),
        None => (dotted, None),
    };
    let value = table.get(first.trim())?;
    match rest {
        Some(rest) => look_up(value.as_table()?, rest),
        None => Some(value),
    }
}

fn lay_over(
    base: &mut Table,
    over: &Table,
    source_name: &str,
    prefix: &mut String,
) -> Result<(), ConfigError> {
    for (name, value) in over {
        let key = format!("{prefix}{name}");
        let Some(slot) = base.get_mut(name) else {
            let hint = similar(base.keys(), name)
                .map_or_else(String::new, |near| format!("; did you mean `{prefix}{near}`?"));
            return Err(ConfigError::UnknownKey { source_name: source_name.to_owned(), key, hint });
        };
        match (slot, value) {
            (Value::Table(slot), Value::Table(value)) => {
                lay_over(slot, value, source_name, &mut format!("{key}."))?;
            }
            // A number may be written without a point.
            (Value::Float(slot), Value::Integer(value)) => *slot = *value as f64,
            (slot, value) if slot.same_type(value) => *slot = value.clone(),
            (slot, value) => {
                return Err(ConfigError::WrongType {
                    source_name: source_name.to_owned(),
                    key,
                    value: value.to_string(),
                    found: kind(value),
                    wanted: kind(slot),
                });
            }
        }
    }
    Ok(())
}

fn kind(value: &Value) -> &'static str {
    match value {
        Value::String(_) => "a string",
        Value::Integer(_) => "a whole number",
        Value::Float(_) => "a number",
        Value::Boolean(_) => "true or false",
        Value::Datetime(_) => "a date",
        Value::Array(_) => "a list",
        Value::Table(_) => "a table",
    }
}

fn similar<'a>(keys: impl Iterator<Item = &'a String>, wanted: &str) -> Option<&'a String> {
    keys.map(|key| (strsim::jaro_winkler(key, wanted), key))
        .filter(|(likeness, _)| *likeness > 0.75)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, key)| key)
}

/// The key of a table, at any depth, whose last part is most similar to a name.
fn elsewhere(all: &Table, name: &str) -> Option<String> {
    let paths = single_values(all).into_iter().map(|(path, _)| path);
    let likeness =
        paths.filter_map(|path| Some((strsim::jaro_winkler(path.last()?, name), path.join("."))));
    let near = likeness.filter(|(likeness, _)| *likeness > 0.9);
    near.max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, key)| key)
}

/// The value of an enumeration that a text names.
///
/// # Errors
/// Which names there are.
pub fn named<T: DeserializeOwned>(text: &str) -> Result<T, String> {
    let text: StrDeserializer<'_, ValueError> = text.into_deserializer();
    T::deserialize(text).map_err(|cause| cause.to_string())
}

/// An address without a name and a password: without the text between its scheme and the last `@` before the path, or, where
/// a password contains a slash, before the end.
pub fn without_credentials(address: &str) -> String {
    let (scheme, rest) = match address.split_once("://") {
        Some((scheme, rest)) => (format!("{scheme}://"), rest),
        None => (String::new(), address),
    };
    let end = rest.find(['/', '?', '#']).unwrap_or(rest.len());
    let authority = &rest[..end];
    let is_port = |text: &str| text.chars().all(|it| it.is_ascii_digit());
    let has_odd_port = authority.rsplit_once(':').is_some_and(|(_, port)| !is_port(port));
    let at = match authority.rfind('@') {
        None if has_odd_port => rest.rfind('@'),
        at => at,
    };
    let shown = at.map_or(rest, |at| &rest[at + 1..]);
    format!("{scheme}{shown}")
}

/// A setting, its value or an error text as it is reported, without the passwords that an address in any line may contain.
fn shown(text: &str) -> String {
    let line = |line: &str| {
        let mut parts = line.split("://");
        let before = parts.next().unwrap_or_default().to_owned();
        parts.fold(before, |before, rest| format!("{before}://{}", without_credentials(rest)))
    };
    text.split('\n').map(line).collect::<Vec<_>>().join("\n")
}

/// The rule of [`is_name`].
pub const NAME_RULE: &str = "a name has 1 to 64 letters, digits, `-` and `_`";

/// Whether a text is a name: it becomes a part of topic keys.
pub fn is_name(text: &str) -> bool {
    (1..=64).contains(&text.len())
        && text.chars().all(|c| c.is_ascii_alphanumeric() || "-_".contains(c))
}

/// Collects the first invalid value, with the layer it came from.
pub struct Check<'a> {
    table: &'a Table,
    layers: &'a [Layer],
    problem: Option<ConfigError>,
}

impl Check<'_> {
    /// The number `key` must be within `range`.
    pub fn range<N: PartialOrd + Display>(
        &mut self,
        key: &str,
        value: N,
        range: RangeInclusive<N>,
    ) {
        let limit = || format!("it must be from {} to {}", range.start(), range.end());
        self.holds(key, range.contains(&value), limit);
    }

    /// The number `key` must be at least the value of another key.
    pub fn at_least(&mut self, key: &str, value: f64, other: &str, min: f64) {
        self.holds(key, value >= min, || format!("it must be >= `{other}` ({min})"));
    }

    /// The value of `key` must be one of `allowed`.
    pub fn one_of(&mut self, key: &str, value: &str, allowed: &[&str]) {
        self.holds(key, allowed.contains(&value), || {
            format!("it must be one of {}", allowed.join(", "))
        });
    }

    /// The value of `key` must be a name ([`is_name`]).
    pub fn name(&mut self, key: &str, value: &str) {
        self.holds(key, is_name(value), || NAME_RULE.to_owned());
    }

    /// The value of `key` must be accepted by `parse`.
    pub fn parses<T, E: Display>(&mut self, key: &str, result: Result<T, E>) {
        let problem = result.err().map(|e| e.to_string());
        self.holds(key, problem.is_none(), || problem.unwrap_or_default());
    }

    fn holds(&mut self, key: &str, holds: bool, limit: impl FnOnce() -> String) {
        if holds || self.problem.is_some() {
            return;
        }
        let source_name = self
            .layers
            .iter()
            .rev()
            .find(|layer| look_up(&layer.table, key).is_some())
            .map_or_else(|| "the defaults".to_owned(), |layer| layer.name.clone());
        let value = look_up(self.table, key).map_or_else(String::new, ToString::to_string);
        self.problem =
            Some(ConfigError::Refused { source_name, key: key.to_owned(), value, limit: limit() });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::{Deserialize, Serialize};

    #[derive(Debug, Deserialize, PartialEq, Serialize)]
    #[serde(deny_unknown_fields)]
    struct Camera {
        name: String,
        rate_hz: f64,
        lens: Lens,
    }

    #[derive(Debug, Deserialize, PartialEq, Serialize)]
    #[serde(deny_unknown_fields)]
    struct Lens {
        focal_px: f64,
        kind: Kind,
    }

    #[derive(Debug, Deserialize, PartialEq, Serialize)]
    #[serde(rename_all = "kebab-case")]
    enum Kind {
        Pinhole,
        Fisheye,
    }

    impl Settings for Camera {
        const DEFAULTS: &'static str =
            "name = \"down\"\nrate_hz = 15.0\n[lens]\nfocal_px = 1818.0\nkind = \"pinhole\"\n";

        fn from_table(table: Table) -> Result<Self, TableError> {
            table.try_into()
        }

        fn check(&self, check: &mut Check<'_>) {
            check.name("name", &self.name);
            check.range("rate_hz", self.rate_hz, 0.1..=1000.0);
            check.range("lens.focal_px", self.lens.focal_px, 1.0..=1e5);
        }
    }

    fn load(file: Option<&str>, set: &[&str]) -> Result<Camera, String> {
        let holder = tempfile::Builder::new().suffix(".toml").tempfile().unwrap();
        if let Some(text) = file {
            std::fs::write(holder.path(), text).unwrap();
        }
        let layers = Layers {
            file: file.map(|_| holder.path().to_owned()),
            set: set.iter().map(|s| (*s).to_owned()).collect(),
        };
        layers.load::<Camera>().map(|c| c.settings).map_err(|e| e.to_string())
    }

    #[test]
    fn a_refused_value_is_reported_without_the_passwords_in_its_addresses() {
        let address = "rtsp://me:s3cret@host:554/main";
        let set = |key: &str| load(None, &[&format!("{key}={address}")]).unwrap_err();
        let file = load(Some(&format!("name = \"{address}\"")), &[]).unwrap_err();
        for problem in [file, set("name"), set("rate_hz"), set("nam")] {
            assert!(!problem.contains("s3cret"), "{problem}");
            assert!(problem.contains("//host:554/main") || problem.contains("nam`"), "{problem}");
        }
        // Also where the quotes are missing, and in a word that a key or an enumeration lacks.
        let word = format!("lens.kind = \"{address}\"");
        for text in [format!("name = {address}"), format!("\"{address}\" = 1"), word] {
            let problem = load(Some(&text), &[]).unwrap_err();
            assert!(
                !problem.contains("s3cret") && problem.contains("//host:554/main"),
                "{problem}"
            );
        }
        let two = format!("rate_hz=[\"{address}\", \"rtsp://you:0ther@host\"]");
        for problem in [load(Some(&two), &[]).unwrap_err(), load(None, &[&two]).unwrap_err()] {
            let is_shown = ["s3cret", "0ther"].iter().any(|password| problem.contains(password));
            assert!(!is_shown && problem.contains("\"rtsp://host\""), "{problem}");
        }
        let form = load(None, &[address]).unwrap_err();
        assert!(form.contains("`rtsp://host:554/main`") && !form.contains("s3cret"), "{form}");
    }

    #[test]
    fn a_file_that_is_not_utf_8_is_reported_with_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("settings.toml");
        for (bytes, parts) in [
            (&b"a = 1\n\n# H\xf6he\n"[..], ["line 3: save it as UTF-8", "settings.toml"]),
            (b"\xff\xfea\0 \0=\0", ["line 1, but UTF-16", "save it as UTF-8"]),
        ] {
            std::fs::write(&path, bytes).unwrap();
            let problem = read_text(&path).unwrap_err().to_string();
            assert!(parts.iter().all(|part| problem.contains(part)), "{problem}");
        }
    }

    #[test]
    fn settings_override_the_file_and_the_file_the_defaults() {
        let camera =
            load(Some("rate_hz = 20\n[lens]\nfocal_px = 900.0"), &["rate_hz=30", "name=left"]);
        let lens = Lens { focal_px: 900.0, kind: Kind::Pinhole };
        assert_eq!(camera, Ok(Camera { name: "left".into(), rate_hz: 30.0, lens }));
    }

    #[test]
    fn a_string_that_looks_like_a_number_stays_a_string() {
        assert_eq!(load(None, &["name=7"]).unwrap().name, "7");
    }

    #[test]
    fn errors_name_source_key_value_and_limit() {
        let check = |file: Option<&str>, set: &[&str], parts: &[&str]| {
            let problem = load(file, set).unwrap_err();
            for part in parts {
                assert!(problem.contains(part), "`{part}` is not in: {problem}");
            }
        };
        check(
            None,
            &["rate_hx=1"],
            &["--set rate_hx=1", "no key `rate_hx`", "did you mean `rate_hz`"],
        );
        check(Some("[lens]\nfocal = 1.0"), &[], &[".toml", "`lens.focal`", "`lens.focal_px`?"]);
        // In another table than the one where it is.
        check(None, &["focal_px=900"], &["no key `focal_px`", "did you mean `lens.focal_px`?"]);
        check(None, &["optics.focal_px=9"], &["`optics`", "did you mean `lens.focal_px`?"]);
        check(Some("[optics]\nfocal_pixel = 9.0"), &[], &["did you mean `lens.focal_px`?"]);
        assert!(!load(None, &["zoom=2"]).unwrap_err().contains("did you mean"));
        check(Some("rate_hz = 0"), &[], &[".toml", "`rate_hz` = 0", "from 0.1 to 1000"]);
        check(None, &["rate_hz=nan"], &["from 0.1 to 1000"]);
        check(
            None,
            &["rate_hz=true"],
            &["`rate_hz` = true is true or false, where a number is needed"],
        );
        check(None, &["rate_hz"], &["not of the form key=value"]);
        check(None, &["nam=a b"], &["no key `nam`", "did you mean `name`?"]);
        check(
            None,
            &["rate_hz=1 2"],
            &["`rate_hz` = 1 2 is no value that TOML has, where a number is needed"],
        );
        check(None, &["rate_hz=fast"], &["--set rate_hz=fast", "where a number is needed"]);
        check(Some("rate_hz = = 1"), &[], &["is not valid TOML", ".toml"]);
        check(None, &["name=a/b"], &["letters, digits"]);
    }

    #[test]
    fn an_unknown_variant_is_reported_with_its_source_and_the_allowed_words() {
        let words = ["`lens.kind` = \"wide\" is invalid", "`pinhole`", "`fisheye`"];
        for (file, set, source) in [
            (None, &["lens.kind=wide", "rate_hz=30"][..], "--set lens.kind=wide: "),
            (None, &["rate_hz=30", "lens.kind=wide"][..], "--set lens.kind=wide: "),
            (Some("[lens]\nfocal_px = 2.0\nkind = \"wide\""), &["rate_hz=30"][..], ".toml: "),
        ] {
            let problem = load(file, set).unwrap_err();
            assert!(problem.contains(source) && !problem.contains("TOML"), "{problem}");
            assert!(words.iter().all(|word| problem.contains(word)), "{problem}");
        }
        // A later layer corrects an earlier one.
        assert!(load(Some("lens.kind = \"wide\""), &["lens.kind=fisheye"]).is_ok());
    }

    #[test]
    fn a_setting_changes_the_configuration_in_use() {
        let camera = load(None, &["rate_hz=30"]).unwrap();
        let changed = |setting| changed(&camera, setting).map_err(|e| e.to_string());
        let left = changed("name=left").unwrap();
        assert_eq!((left.name.as_str(), left.rate_hz), ("left", 30.0));
        assert_eq!(changed("lens.focal_px=900").unwrap().lens.focal_px, 900.0);
        for (setting, part) in [
            ("rate_hz=0", "from 0.1 to 1000"),
            ("rate_hx=1", "did you mean `rate_hz`"),
            ("rate_hz=[]", "a list"),
            ("rate_hz", "key=value"),
        ] {
            let problem = changed(setting).unwrap_err();
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        }
    }

    #[test]
    fn a_setting_of_several_services_is_named_with_its_service() {
        for setting in ["rate_hz", "rate_hz=fast", "rate_hz=0", "rate_hx=1", "rate_hz=[]"] {
            let layers = Layers { file: None, set: vec![setting.to_owned()] };
            let problem = layers.load::<Camera>().unwrap_err().of_service("camera").to_string();
            assert!(problem.contains(&format!("camera.{setting}")), "{problem}");
        }
    }

    #[test]
    fn a_missing_file_is_named() {
        let layers = Layers { file: Some("no/such/file.toml".into()), set: Vec::new() };
        let problem = layers.load::<Camera>().unwrap_err().to_string();
        assert!(problem.contains("no/such/file.toml"), "{problem}");
    }
}
