//! Reads and writes a relay's list of certificate holders, valid and revoked, and makes Zenoh's access control of that
//! list and of the rules of the roles: on which keys each may publish, subscribe and query.
//!
//! The common name of a certificate is `ROLE@VEHICLE` or `ROLE.NAME@VEHICLE`. A relay accepts only the holders
//! in its list, of its own vehicle and not revoked; a detector may publish under its own name only. Zenoh compares
//! common names as they are, so each holder becomes a subject of its access control.

use std::collections::BTreeSet;
use std::fmt;
use std::str::FromStr;

use anyhow::{Context, anyhow, ensure};
use serde_json::{Value, json};

use crate::config::{NAME_RULE, is_name};

/// The file name of the list of holders in a directory of keys.
pub const HOLDERS: &str = "holders.txt";

/// The role whose rights are bound to a name.
const DETECTOR: &str = "detector";
/// The beginning of all keys in the rules: any vehicle.
const ANY_VEHICLE: &str = "*/";
/// The beginning of the line of a revoked holder.
const REVOKED: &str = "revoked ";
const HEADING: &str = "\
# The holders that may connect to a relay: the common names of the certificates, one a line; `revoked` before a name excludes it.
# `alight keys` keeps this list in the directory of the authority; every relay needs a copy of it among its keys.
";

/// The holder of a certificate.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Holder {
    role: String,
    name: Option<String>,
    vehicle: String,
}

impl Holder {
    /// A holder; a detector has the name of its instance.
    ///
    /// # Errors
    /// When a part is not a name, or a detector has none.
    pub fn new(role: &str, name: Option<&str>, vehicle: &str) -> anyhow::Result<Self> {
        for part in [Some(role), name, Some(vehicle)].into_iter().flatten() {
            ensure!(is_name(part), "invalid name `{part}`: {NAME_RULE}");
        }
        ensure!(
            role != DETECTOR || name.is_some(),
            "the key of a detector needs the detector's name: add `--name ID`"
        );
        let (role, name) = (role.to_owned(), name.map(str::to_owned));
        Ok(Self { role, name, vehicle: vehicle.to_owned() })
    }

    /// The role.
    pub fn role(&self) -> &str {
        &self.role
    }

    /// The vehicle.
    pub fn vehicle(&self) -> &str {
        &self.vehicle
    }

    /// The name of its files, without the extension: a machine may have the keys of several detectors.
    pub fn key_name(&self) -> String {
        key_name(&self.role, self.name.as_deref().unwrap_or_default())
    }
}

/// The name of the files of a key, without the extension: the role, and of a detector also its name.
pub fn key_name(role: &str, instance: &str) -> String {
    if role == DETECTOR { format!("{role}.{instance}") } else { role.to_owned() }
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.role)?;
        if let Some(name) = &self.name {
            write!(f, ".{name}")?;
        }
        write!(f, "@{}", self.vehicle)
    }
}

impl FromStr for Holder {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        let (subject, vehicle) = text
            .split_once('@')
            .with_context(|| format!("`{text}` is not ROLE@VEHICLE or ROLE.NAME@VEHICLE"))?;
        match subject.split_once('.') {
            Some((role, name)) => Self::new(role, Some(name), vehicle),
            None => Self::new(subject, None, vehicle),
        }
    }
}

/// The list of holders.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Holders {
    admitted: BTreeSet<Holder>,
    revoked: BTreeSet<Holder>,
}

impl Holders {
    /// Adds a holder.
    ///
    /// # Errors
    /// When it was revoked: the old certificate has the same name.
    pub fn admit(&mut self, holder: &Holder) -> anyhow::Result<()> {
        ensure!(
            !self.revoked.contains(holder),
            "`{holder}` was revoked, and a new key of this name would make the old one valid again; give another `--name`"
        );
        self.admitted.insert(holder.clone());
        Ok(())
    }

    /// Excludes a holder permanently.
    ///
    /// # Errors
    /// When it is not in the list.
    pub fn revoke(&mut self, holder: &Holder) -> anyhow::Result<()> {
        ensure!(
            self.admitted.remove(holder) || self.revoked.contains(holder),
            "no key was issued to `{holder}`; {HOLDERS} next to the authority's key lists all"
        );
        self.revoked.insert(holder.clone());
        Ok(())
    }

    /// True when it is in the list, and not revoked.
    pub fn admits(&self, holder: &Holder) -> bool {
        self.admitted.contains(holder)
    }

    /// The holders that may connect, sorted.
    pub fn admitted(&self) -> impl Iterator<Item = &Holder> {
        self.admitted.iter()
    }

    /// The revoked holders, sorted.
    pub fn revoked(&self) -> impl Iterator<Item = &Holder> {
        self.revoked.iter()
    }

    /// True when a vehicle's key in this role is among them.
    pub fn has(&self, role: &str, vehicle: &str) -> bool {
        self.of(role, vehicle).next().is_some()
    }

    /// The holders of a vehicle's keys in a role.
    fn of<'a>(&'a self, role: &'a str, vehicle: &'a str) -> impl Iterator<Item = &'a Holder> {
        let of_both = move |holder: &&Holder| holder.role == role && holder.vehicle == vehicle;
        self.admitted.iter().filter(of_both)
    }
}

impl fmt::Display for Holders {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(HEADING)?;
        self.admitted.iter().try_for_each(|holder| writeln!(f, "{holder}"))?;
        self.revoked.iter().try_for_each(|holder| writeln!(f, "{REVOKED}{holder}"))
    }
}

impl FromStr for Holders {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<Self> {
        let mut holders = Self::default();
        for line in text.lines().map(str::trim).filter(|l| !l.is_empty() && !l.starts_with('#')) {
            match line.strip_prefix(REVOKED) {
                Some(name) => drop(holders.revoked.insert(name.trim().parse()?)),
                None => drop(holders.admitted.insert(line.parse()?)),
            }
        }
        // Of two lines about one holder the stricter holds.
        holders.admitted.retain(|holder| !holders.revoked.contains(holder));
        Ok(holders)
    }
}

/// The access control of a vehicle's relay: the rules of all roles, for these holders and this vehicle, and with each right
/// to subscribe that to be sent the messages.
///
/// # Errors
/// When the rules are not as expected.
pub fn access_control(rules: &Value, holders: &Holders, vehicle: &str) -> anyhow::Result<Value> {
    let list = |key: &str| -> anyhow::Result<&Vec<Value>> {
        rules[key].as_array().ok_or_else(|| anyhow!("`access_control.{key}` is not a list"))
    };
    let detectors: Vec<&Holder> = holders.of(DETECTOR, vehicle).collect();
    let mut subjects = Vec::new();
    for subject in list("subjects")? {
        let Some(roles) = subject["cert_common_names"].as_array() else {
            subjects.push(subject.clone());
            continue;
        };
        let roles: Vec<&str> = roles.iter().filter_map(Value::as_str).collect();
        let of_roles = roles.iter().flat_map(|role| holders.of(role, vehicle));
        let mut named = subject.clone();
        if roles == [DETECTOR] {
            for holder in of_roles {
                named["id"] = json!(holder.to_string());
                named["cert_common_names"] = json!([holder.to_string()]);
                subjects.push(named.clone());
            }
        } else {
            let names: Vec<String> = of_roles.map(ToString::to_string).collect();
            // Without a name the subject would be every client.
            if !names.is_empty() {
                named["cert_common_names"] = json!(names);
                subjects.push(named);
            }
        }
    }
    let known: BTreeSet<&str> = subjects.iter().filter_map(|s| s["id"].as_str()).collect();
    let mut policies = Vec::new();
    for policy in list("policies")? {
        let names = policy["subjects"].as_array().into_iter().flatten().filter_map(Value::as_str);
        for subject in names {
            if subject == DETECTOR {
                policies.extend(detectors.iter().map(|holder| {
                    let rules = policy["rules"].as_array().into_iter().flatten();
                    let rules = rules.filter_map(Value::as_str).map(|rule| bound_id(rule, holder));
                    json!({ "rules": rules.collect::<Vec<_>>(), "subjects": [holder.to_string()] })
                }));
            } else if known.contains(subject) {
                policies.push(json!({ "rules": policy["rules"], "subjects": [subject] }));
            }
        }
    }
    let mut bound = Vec::new();
    for rule in list("rules")? {
        let id = rule["id"].as_str().unwrap_or_default();
        if is_of_detectors(id) {
            bound.extend(detectors.iter().map(|holder| {
                let mut own = with_keys(rule, |key| bound_key(key, holder));
                own["id"] = json!(bound_id(id, holder));
                own
            }));
        } else {
            bound.push(with_keys(rule, |key| of_vehicle(key, vehicle)));
        }
    }
    bound.retain(|rule| policies.iter().any(|policy| names_rule(policy, &rule["id"])));
    let received: Vec<Value> = bound.iter().filter_map(received).collect();
    for policy in &mut policies {
        let rules = policy["rules"].as_array().cloned().unwrap_or_default();
        let added = received.iter().map(|rule| rule["id"].clone());
        let added = added.filter(|id| rules.iter().any(|rule| *id == json!(received_id(rule))));
        let all: Vec<Value> = rules.iter().cloned().chain(added).collect();
        policy["rules"] = json!(all);
    }
    bound.extend(received);
    let mut access = rules.clone();
    access["rules"] = json!(bound);
    access["subjects"] = json!(subjects);
    access["policies"] = json!(policies);
    Ok(access)
}

/// For a rule that allows to subscribe, the rule that allows to send the messages to the subscriber. Without it a session of a
/// certain kind would receive messages to which it never subscribed.
fn received(rule: &Value) -> Option<Value> {
    let messages = rule["messages"].as_array()?;
    messages.iter().any(|message| message == "declare_subscriber").then_some(())?;
    let flows = rule["flows"].as_array()?;
    flows.iter().any(|flow| flow == "ingress").then_some(())?;
    let mut sent = rule.clone();
    sent["id"] = json!(received_id(&rule["id"]));
    sent["flows"] = json!(["egress"]);
    sent["messages"] = json!(["put", "delete"]);
    Some(sent)
}

/// The id of the rule that allows to send to a subscriber.
fn received_id(rule: &Value) -> String {
    format!("received by {}", rule.as_str().unwrap_or_default())
}

fn names_rule(policy: &Value, id: &Value) -> bool {
    policy["rules"].as_array().is_some_and(|rules| rules.contains(id))
}

fn is_of_detectors(rule: &str) -> bool {
    rule.starts_with(DETECTOR)
}

/// The id of a rule for one holder; the rules of detectors are bound to it.
fn bound_id(rule: &str, holder: &Holder) -> String {
    if is_of_detectors(rule) { format!("{rule} of {holder}") } else { rule.to_owned() }
}

fn with_keys(rule: &Value, change: impl Fn(&str) -> String) -> Value {
    let keys = rule["key_exprs"].as_array().into_iter().flatten().filter_map(Value::as_str);
    let keys: Vec<String> = keys.map(change).collect();
    let mut changed = rule.clone();
    changed["key_exprs"] = json!(keys);
    changed
}

fn of_vehicle(key: &str, vehicle: &str) -> String {
    match key.strip_prefix(ANY_VEHICLE) {
        Some(rest) => format!("{vehicle}/{rest}"),
        None => key.to_owned(),
    }
}

/// A key in the rules of detectors, for one detector: its name is behind the chunk `detector`.
fn bound_key(key: &str, holder: &Holder) -> String {
    let name = holder.name.as_deref().unwrap_or_default();
    let key = of_vehicle(key, &holder.vehicle);
    match key.strip_suffix(&format!("/{DETECTOR}/**")) {
        Some(front) => format!("{front}/{DETECTOR}/{name}/**"),
        None => key.replacen(&format!("/{DETECTOR}/*"), &format!("/{DETECTOR}/{name}"), 1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn holders(text: &str) -> Holders {
        text.parse().unwrap()
    }

    #[test]
    fn names_are_read_as_they_are_written() {
        for text in ["operator@drone", "detector.ground@kestrel", "operator.alice@drone"] {
            assert_eq!(text.parse::<Holder>().unwrap().to_string(), text);
        }
        for text in ["", "operator", "detector@drone", "operator@", "a b@drone", "x.y.z@drone"] {
            assert!(text.parse::<Holder>().is_err(), "{text}");
        }
        let list = holders("operator@drone\n# x\n\nrevoked detector.old@drone\n");
        assert_eq!(list.to_string().parse::<Holders>().unwrap(), list);
    }

    #[test]
    fn revoked_holders_stay_excluded() {
        let mut list = holders("operator@drone\nrevoked operator@drone\n");
        assert_eq!(list.of("operator", "drone").count(), 0);
        let operator: Holder = "operator@drone".parse().unwrap();
        let problem = list.admit(&operator).unwrap_err().to_string();
        assert!(problem.contains("another `--name`"), "{problem}");
        let unknown = "operator.bob@drone".parse().unwrap();
        assert!(list.revoke(&unknown).is_err());
        list.admit(&unknown).unwrap();
        list.revoke(&unknown).unwrap();
        assert_eq!(list.of("operator", "drone").count(), 0);
    }

    #[test]
    fn messages_are_sent_only_on_keys_to_which_their_receiver_may_subscribe() {
        let rules: Value = json5::from_str(crate::network::SECURED_CONFIG).unwrap();
        let roles = "camera-pub controller dashboard gcs-bridge operator observer recorder simulator relay drone";
        let names: String = roles.split(' ').map(|role| format!("{role}@kestrel\n")).collect();
        let holders = holders(&format!("{names}detector.one@kestrel\n"));
        let access = access_control(&rules["access_control"], &holders, "kestrel").unwrap();
        crate::network::check_access(&json!({ "access_control": access.clone() })).unwrap();
        let has = |value: &Value, wanted: &str| value.as_array().unwrap().contains(&json!(wanted));
        let keys = |subject: &Value, flow: &str, message: &str| -> BTreeSet<String> {
            let policies = access["policies"].as_array().unwrap().iter();
            let policies =
                policies.filter(|it| it["subjects"].as_array().unwrap().contains(subject));
            let ids: Vec<&Value> =
                policies.flat_map(|it| it["rules"].as_array().unwrap()).collect();
            let rules = access["rules"].as_array().unwrap().iter();
            rules
                .filter(|it| ids.contains(&&it["id"]))
                .filter(|it| has(&it["flows"], flow) && has(&it["messages"], message))
                .flat_map(|it| it["key_exprs"].as_array().unwrap())
                .map(|key| key.as_str().unwrap().to_owned())
                .collect()
        };
        let subjects: Vec<&Value> =
            access["subjects"].as_array().unwrap().iter().map(|it| &it["id"]).collect();
        assert!(subjects.len() > 10, "{subjects:?}");
        for subject in subjects {
            let subscribed = keys(subject, "ingress", "declare_subscriber");
            assert!(!subscribed.is_empty(), "{subject}");
            for message in ["put", "delete"] {
                assert_eq!(keys(subject, "egress", message), subscribed, "{subject}: {message}");
            }
        }
        let detector = keys(&json!("detector.one@kestrel"), "egress", "put");
        assert!(detector.contains("kestrel/camera/*/jpeg") && !detector.contains("**"));
        assert!(!detector.iter().any(|key| key.contains("mavlink")), "{detector:?}");
        assert_eq!(keys(&json!("own"), "egress", "put"), BTreeSet::from(["**".to_owned()]));
    }

    #[test]
    fn a_detectors_keys_are_bound_to_its_name_and_vehicle() {
        let holder: Holder = "detector.ground@kestrel".parse().unwrap();
        for (key, bound) in [
            ("*/detector/*/detections", "kestrel/detector/ground/detections"),
            ("*/detector/*/debug/*", "kestrel/detector/ground/debug/*"),
            ("*/health/detector/*", "kestrel/health/detector/ground"),
            ("*/alive/detector/**", "kestrel/alive/detector/ground/**"),
        ] {
            assert_eq!(bound_key(key, &holder), bound);
        }
    }
}
