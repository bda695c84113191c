//! Reads the funnel within which a controller descends from its published configuration.

use messages::Configuration;
use serde::Serialize;
use toml::{Table, Value};

/// Maximum length of a configuration that is read, in bytes.
const MAX_TOML: usize = 200_000;

/// The maximum horizontal distance from the pad for a descent.
#[derive(Copy, Clone, Debug, PartialEq, Serialize)]
pub struct Funnel {
    /// Radius at the pad, in metres.
    pub radius_m: f64,
    /// Growth of the radius per metre of height.
    pub per_height: f64,
}

impl Funnel {
    /// The funnel of a controller with the metric guidance; `None` for any other or unreadable configuration.
    pub fn of(configuration: &Configuration) -> Option<Self> {
        if configuration.service != "controller" || configuration.toml.len() > MAX_TOML {
            return None;
        }
        let table: Table = configuration.toml.parse().ok()?;
        let is_metric = table.get("guidance")?.as_str()? == "metric";
        let metric = table.get("metric")?;
        let number = |key: &str| match metric.get(key)? {
            Value::Float(number) => Some(*number).filter(|number| number.is_finite()),
            Value::Integer(number) => Some(*number as f64),
            _ => None,
        };
        let funnel =
            Self { radius_m: number("funnel_m")?, per_height: number("funnel_per_height")? };
        is_metric.then_some(funnel)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(service: &str, toml: &str) -> Option<Funnel> {
        let text = String::new();
        Funnel::of(&Configuration {
            service: service.into(),
            instance: "main".into(),
            host: text.clone(),
            version: text,
            toml: toml.into(),
        })
    }

    #[test]
    fn the_funnel_is_that_of_the_configuration() {
        let defaults = include_str!("../../controller/controller.toml");
        assert_eq!(of("controller", defaults), Some(Funnel { radius_m: 0.08, per_height: 0.25 }));
        let complete = "guidance = 'metric'\n[metric]\nfunnel_m = 1\nfunnel_per_height = 0";
        assert_eq!(of("controller", complete), Some(Funnel { radius_m: 1.0, per_height: 0.0 }));
        for none in [
            "",
            "guidance = ",
            "guidance = 'metric'\n[metric]\nfunnel_m = 1",
            "guidance = 'metric'\n[metric]\nfunnel_m = inf\nfunnel_per_height = 0",
            "guidance = 'thesis'\n[metric]\nfunnel_m = 1\nfunnel_per_height = 0",
        ] {
            assert_eq!(of("controller", none), None, "{none}");
        }
        assert_eq!(of("detector", defaults), None);
        assert_eq!(of("controller", &" ".repeat(MAX_TOML + 1)), None);
    }
}
