//! Access rights: the rules in `zenoh-config/secured.json5` match the topic table.

use std::collections::BTreeSet;

use anyhow::{Context, ensure};
use messages::{Delivery, MONITORS, Row, TOPICS, topic};
use node::network::{SECURED_CONFIG, check_access};
use serde_json::Value;
use zenoh::key_expr::KeyExpr;

/// The roles of the certificates, and their names in the topic table.
const ROLES: [(&str, &str); 9] = [
    ("camera-pub", "camera-pub"),
    ("controller", "controller"),
    ("dashboard", "dashboard"),
    ("detector", "detector"),
    ("gcs-bridge", "gcs-bridge"),
    ("operator", "alight"),
    ("recorder", "recorder"),
    ("simulator", "simulator"),
    ("observer", "observer"),
];

/// The incoming messages by which a role subscribes, publishes, queries, replies and sees the processes that are present.
const MESSAGES: [&str; 8] = [
    "declare_subscriber",
    "put",
    "query",
    "reply",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
];

fn access() -> anyhow::Result<Value> {
    let config: Value = json5::from_str(SECURED_CONFIG)?;
    check_access(&config)?;
    Ok(config["access_control"].clone())
}

fn list<'a>(value: &'a Value, key: &str) -> impl Iterator<Item = &'a Value> {
    value[key].as_array().into_iter().flatten()
}

fn has(value: &Value, key: &str, wanted: &str) -> bool {
    list(value, key).any(|entry| entry == wanted)
}

/// The rights of a role: (message, key expression).
fn rights(access: &Value, role: &str) -> BTreeSet<(String, String)> {
    let subjects: Vec<_> = list(access, "subjects")
        .filter(|s| has(s, "cert_common_names", role))
        .filter_map(|s| s["id"].as_str())
        .collect();
    let policies =
        list(access, "policies").filter(|p| subjects.iter().any(|s| has(p, "subjects", s)));
    let names: Vec<_> = policies.flat_map(|p| list(p, "rules")).collect();
    let rules = list(access, "rules").filter(|rule| {
        names.contains(&&rule["id"])
            && has(rule, "flows", "ingress")
            && rule["permission"] == "allow"
    });
    let mut rights = BTreeSet::new();
    for rule in rules {
        for message in MESSAGES.iter().filter(|m| has(rule, "messages", m)) {
            for key in list(rule, "key_exprs").filter_map(Value::as_str) {
                rights.insert(((*message).to_owned(), key.to_owned()));
            }
        }
    }
    rights
}

fn may(rights: &BTreeSet<(String, String)>, message: &str, key: &str) -> anyhow::Result<bool> {
    let key = KeyExpr::new(key.to_owned()).map_err(|cause| anyhow::anyhow!("{cause}"))?;
    for (_, allowed) in rights.iter().filter(|(m, _)| m == message) {
        let allowed = KeyExpr::new(allowed.as_str())
            .map_err(|cause| anyhow::anyhow!("{allowed}: {cause}"))?;
        if allowed.includes(&key) {
            return Ok(true);
        }
    }
    Ok(false)
}

/// The row's key on the wire for a service.
fn key_on_the_wire(row: &Row, service: &str) -> String {
    format!("a-drone/{}", row.key.replace("{service}", service)).replace(['{', '}'], "")
}

/// Whether a service may subscribe to a row's topic.
fn subscribes(row: &Row, service: &str) -> bool {
    MONITORS.contains(&service) || row.subscribers.contains(&service)
}

/// Whether a row is the reply to a command, which has the key of the command.
fn is_reply(row: &Row) -> bool {
    row.message == "CommandReply"
}

#[test]
fn the_access_rules_allow_exactly_the_rights_of_the_topic_table() -> anyhow::Result<()> {
    let access = access()?;
    for (role, service) in ROLES {
        let rights = rights(&access, role);
        for row in TOPICS {
            let key = key_on_the_wire(row, service);
            let stated = row.publishers.contains(&service);
            let messages: &[&str] = match row.delivery {
                Delivery::Query if is_reply(row) => &["declare_queryable", "reply"],
                Delivery::Query => &["query"],
                Delivery::LastValue | Delivery::Record => &["put", "declare_queryable", "reply"],
                Delivery::Latest | Delivery::LatestPriority | Delivery::Reliable => &["put"],
            };
            // A subscriber queries the last value, and the earlier messages of a record.
            let receiving: &[&str] = match row.delivery {
                Delivery::LastValue | Delivery::Record => &["declare_subscriber", "query"],
                _ => &["declare_subscriber"],
            };
            let sending = messages.iter().map(|message| (message, stated));
            let receiving = receiving.iter().map(|message| (message, subscribes(row, service)));
            for (message, stated) in sending.chain(receiving) {
                let allowed = may(&rights, message, &key)?;
                ensure!(
                    allowed == stated,
                    "{role}: {message} on {key} is {allowed} by the rules, {stated} by the table"
                );
            }
        }
    }
    Ok(())
}

#[test]
fn every_access_rule_has_a_row_in_the_topic_table() -> anyhow::Result<()> {
    let access = access()?;
    for (role, service) in ROLES {
        for (message, allowed) in rights(&access, role) {
            let allowed_key =
                KeyExpr::new(allowed.as_str()).map_err(|cause| anyhow::anyhow!("{cause}"))?;
            let alive = format!("a-drone/{}", topic::alive_key(service, "name"));
            let mut keys: Vec<String> = TOPICS
                .iter()
                .filter(|row| match message.as_str() {
                    "declare_subscriber" => subscribes(row, service),
                    "query" if matches!(row.delivery, Delivery::LastValue | Delivery::Record) => {
                        subscribes(row, service)
                    }
                    _ => row.publishers.contains(&service),
                })
                .map(|row| key_on_the_wire(row, service))
                .collect();
            keys.push(alive);
            let named = keys
                .iter()
                .any(|key| KeyExpr::new(key.as_str()).is_ok_and(|key| allowed_key.includes(&key)));
            ensure!(named, "{role}: {message} on {allowed} has no row in the topic table");
        }
    }
    Ok(())
}

#[test]
fn no_role_has_rights_to_wildcards() -> anyhow::Result<()> {
    let access = access()?;
    for (role, service) in ROLES {
        for key in ["a-drone/**", "a-drone/*/command", "a-drone/controller/*", "**"] {
            for message in ["put", "query", "declare_queryable", "reply"] {
                ensure!(!may(&rights(&access, role), message, key)?, "{role}: {message} on {key}");
            }
            // Monitors subscribe to everything of a vehicle.
            let subscribes = may(&rights(&access, role), "declare_subscriber", key)?;
            let is_allowed = MONITORS.contains(&service) && key != "**";
            ensure!(subscribes == is_allowed, "{role}: subscribes to {key}: {subscribes}");
        }
    }
    // Every service of the table has a role, except the relay, which forwards.
    let named: BTreeSet<_> = TOPICS
        .iter()
        .flat_map(|row| row.publishers.iter().chain(row.subscribers))
        .chain(MONITORS)
        .copied()
        .collect();
    let known: BTreeSet<_> = ROLES.iter().map(|(_, service)| *service).chain(["relay"]).collect();
    ensure!(named.is_subset(&known), "no role for {:?}", named.difference(&known));
    Ok(())
}

#[test]
fn every_role_sees_the_processes_that_are_present() -> anyhow::Result<()> {
    let access = access()?;
    for (role, _) in ROLES {
        for message in ["liveliness_query", "declare_liveliness_subscriber"] {
            ensure!(may(&rights(&access, role), message, "a-drone/alive/**")?, "{role}: {message}");
        }
    }
    Ok(())
}

#[test]
fn relays_have_all_rights() -> anyhow::Result<()> {
    let access = access()?;
    for role in ["drone", "relay"] {
        let rights = rights(&access, role);
        ensure!(may(&rights, "put", "a-drone/**").context(role)?, "{role}");
    }
    Ok(())
}
