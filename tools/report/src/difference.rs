//! Compares two flights: configurations and the autopilot's parameters.

use std::collections::{BTreeMap, BTreeSet};

use toml::Value;

use crate::flight::Flight;
use crate::settings::{Difference, differences, flatten};

/// The settings in which the services of two flights differ.
pub fn configurations(one: &Flight, other: &Flight) -> Vec<Difference> {
    differences(&settings(one), &settings(other))
}

/// The parameters of the autopilot in which two flights differ, of those that both recorded.
pub fn parameters(one: &Flight, other: &Flight) -> Vec<Difference> {
    let texts = |flight: &Flight, other_flight: &Flight| -> BTreeMap<String, String> {
        let parameters = flight.packets.parameters.iter();
        parameters
            .filter(|(name, _)| other_flight.packets.parameters.contains_key(*name))
            .map(|(name, value)| (name.clone(), value.to_string()))
            .collect()
    };
    differences(&texts(one, other), &texts(other, one))
}

/// The names of parameters that only one of two flights recorded.
pub fn parameters_of_one(one: &Flight, other: &Flight) -> Vec<String> {
    let names =
        |flight: &Flight| flight.packets.parameters.keys().cloned().collect::<BTreeSet<String>>();
    names(one).symmetric_difference(&names(other)).cloned().collect()
}

/// All settings of a flight by `service/instance: key`.
fn settings(flight: &Flight) -> BTreeMap<String, String> {
    let mut settings = BTreeMap::new();
    for (service, text) in &flight.configurations {
        match text.parse::<toml::Table>() {
            Ok(table) => flatten("", &Value::Table(table), &mut |path, value| {
                settings.insert(format!("{service}: {path}"), value);
            }),
            Err(error) => {
                settings.insert(format!("{service}: "), format!("cannot be read: {error}"));
            }
        }
    }
    settings
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flight(toml: &str, parameters: &[(&str, f64)]) -> Flight {
        let mut flight = Flight::default();
        flight.configurations.insert("controller/main".to_owned(), toml.to_owned());
        let parameters = parameters.iter().map(|(name, value)| ((*name).to_owned(), *value));
        flight.packets.parameters.extend(parameters);
        flight
    }

    #[test]
    fn only_differences_are_listed_by_their_full_names() {
        let one =
            flight("marker = \"rings\"\n[metric]\nlateral_gain = 1.8", &[("WPNAV_SPEED", 5.0)]);
        let other = flight(
            "marker = \"rings\"\n[metric]\nlateral_gain = 1.2\nnew = true",
            &[("WPNAV_SPEED", 2.0), ("RTL_ALT", 10.0)],
        );
        let found = configurations(&one, &other);
        let names: Vec<&str> = found.iter().map(|it| it.name.as_str()).collect();
        assert_eq!(names, ["controller/main: metric.lateral_gain", "controller/main: metric.new"]);
        assert_eq!(found[0].one.as_deref(), Some("1.8"));
        assert_eq!((found[1].one.as_deref(), found[1].other.as_deref()), (None, Some("true")));
        assert_eq!(configurations(&one, &one), []);
        assert_eq!(parameters(&one, &other).len(), 1);
        assert_eq!(parameters_of_one(&one, &other), ["RTL_ALT"]);
    }
}
