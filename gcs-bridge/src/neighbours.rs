//! Warns of another bridge with the component id of this one: ground stations take the packets of both for those of one companion.

use std::collections::BTreeSet;

use messages::Configuration;
use node::HealthCounters;
use toml::{Table, Value};

use crate::config::Config;

/// Maximum number of bridges that are warned of.
const MAX_BRIDGES: usize = 16;
/// The error in the health report.
const SAME_ID: &str = "another bridge has the same component_id";

/// The other bridges in the network, by their configurations.
#[derive(Debug)]
pub(crate) struct Neighbours {
    /// Name and component id of this bridge.
    name: String,
    component: u8,
    /// Names of those that have the same id.
    with_same_id: BTreeSet<String>,
}

impl Neighbours {
    /// Those of a bridge with this configuration.
    pub(crate) fn new(config: &Config) -> Self {
        let (name, component) = (config.id.clone(), config.component_id);
        Self { name, component, with_same_id: BTreeSet::new() }
    }

    /// Takes the configuration of a bridge, which is repeated; warns once of each that has the same id.
    pub(crate) fn bridge(&mut self, configuration: &Configuration, health: &HealthCounters) {
        let other = configuration.instance.as_str();
        if other == self.name || !self.has_same_id(configuration) {
            self.with_same_id.remove(other);
            return;
        }
        let has_room = self.with_same_id.len() < MAX_BRIDGES;
        if has_room && self.with_same_id.insert(other.to_owned()) {
            health.failed(SAME_ID);
            let component = self.component;
            tracing::warn!(
                other,
                component,
                "Another bridge has the same component id, so a ground station of both cannot distinguish them; \
                 set `component_id` of one of them to another"
            );
        }
    }

    fn has_same_id(&self, configuration: &Configuration) -> bool {
        let table = configuration.toml.parse::<Table>().unwrap_or_default();
        let id = table.get("component_id").and_then(Value::as_integer);
        id == Some(i64::from(self.component))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use node::{Identity, Layers};

    #[test]
    fn each_other_bridge_with_the_same_component_id_is_counted_once() {
        let config = Layers { file: None, set: Vec::new() }.load::<Config>().unwrap().settings;
        let (mut neighbours, health) = (Neighbours::new(&config), HealthCounters::default());
        let text = String::new();
        let mut takes = |instance: &str, toml: &str| {
            let configuration = Configuration {
                service: "gcs-bridge".into(),
                instance: instance.into(),
                host: text.clone(),
                version: text.clone(),
                toml: toml.into(),
            };
            neighbours.bridge(&configuration, &health);
            let identity = Identity { service: "gcs-bridge", instance: "main".into() };
            let errors = health.report(&identity, 0).errors;
            errors.iter().find(|it| it.reason == SAME_ID).map_or(0, |it| it.count)
        };
        let defaults = include_str!("../gcs-bridge.toml");
        assert_eq!(takes("main", defaults), 0, "its own");
        assert_eq!(takes("second", "component_id = 192"), 0);
        assert_eq!(takes("second", "component_id = 'odd'"), 0);
        for _ in 0..3 {
            assert_eq!(takes("second", defaults), 1);
        }
        assert_eq!(takes("third", "component_id = 191"), 2);
    }
}
