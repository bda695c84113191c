//! Flattens settings to their full names, and finds those in which two configurations differ.

use std::collections::{BTreeMap, BTreeSet};

use toml::Value;

/// A value in which two flights, or two configurations, differ.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Difference {
    /// Its name: service and key, or parameter.
    pub name: String,
    /// In the first; `None` when it has no such key.
    pub one: Option<String>,
    /// In the second.
    pub other: Option<String>,
}

/// The settings in which two configurations of a service differ, both as TOML.
pub fn of_service(one: &str, other: &str) -> Vec<Difference> {
    let settings = |text: &str| {
        let mut settings = BTreeMap::new();
        if let Ok(table) = text.parse::<toml::Table>() {
            flatten("", &Value::Table(table), &mut |path, value| {
                settings.insert(path, value);
            });
        }
        settings
    };
    differences(&settings(one), &settings(other))
}

/// The values of two sets that differ, by name.
pub(crate) fn differences(
    one: &BTreeMap<String, String>,
    other: &BTreeMap<String, String>,
) -> Vec<Difference> {
    let names: BTreeSet<&String> = one.keys().chain(other.keys()).collect();
    names
        .into_iter()
        .filter(|name| one.get(*name) != other.get(*name))
        .map(|name| Difference {
            name: name.clone(),
            one: one.get(name).cloned(),
            other: other.get(name).cloned(),
        })
        .collect()
}

/// Hands over each value below another one that is not a table, with its path.
pub(crate) fn flatten(path: &str, value: &Value, take: &mut impl FnMut(String, String)) {
    match value {
        Value::Table(table) => {
            for (key, value) in table {
                let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                flatten(&path, value, take);
            }
        }
        value => take(path.to_owned(), value.to_string()),
    }
}
