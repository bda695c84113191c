//! Follows refusals by their reason (detections, camera information, messages of another version), and warns the operator of those that
//! persist.

use autopilot::without_standstill;

/// Time for which something must be refused before a warning, in nanoseconds: a single refusal means little.
const MIN_LASTING_NS: i64 = 1_000_000_000;
/// Time without a refusal after which a matter is over, in nanoseconds.
const OVER_NS: i64 = 1_500_000_000;
/// Maximum number of matters; further ones are counted in the health only.
const MAX_MATTERS: usize = 16;

/// A warning for the operator.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Warning {
    /// A short name, the same while it persists.
    pub matter: String,
    /// A sentence.
    pub text: String,
}

/// The matters in which something is being refused.
#[derive(Debug, Default)]
pub struct Refusals {
    matters: Vec<Matter>,
}

#[derive(Debug)]
struct Matter {
    reason: &'static str,
    /// The source, such as a detector, where several may be refused for the same reason; otherwise empty.
    source: String,
    text: String,
    since_ns: i64,
    last_ns: i64,
}

impl Refusals {
    /// Something was refused, for a reason (a short name for programs) that `text` explains.
    pub fn add(&mut self, now_ns: i64, reason: &'static str, text: impl FnOnce() -> String) {
        self.add_of(now_ns, reason, "", text);
    }

    /// The same, of one of several that may be refused for one reason.
    pub fn add_of(
        &mut self,
        now_ns: i64,
        reason: &'static str,
        source: &str,
        text: impl FnOnce() -> String,
    ) {
        self.forget(now_ns);
        let is_same = |matter: &&mut Matter| matter.reason == reason && matter.source == source;
        if let Some(matter) = self.matters.iter_mut().find(is_same) {
            matter.last_ns = now_ns;
        } else if self.matters.len() < MAX_MATTERS {
            let (source, text) = (source.to_owned(), text());
            self.matters.push(Matter { reason, source, text, since_ns: now_ns, last_ns: now_ns });
        }
    }

    /// The warnings of refusals that persist.
    pub fn lasting(&self, now_ns: i64) -> impl Iterator<Item = Warning> {
        let lasting = self.matters.iter().filter(move |matter| matter.is_lasting(now_ns));
        lasting.map(|matter| Warning { matter: matter.name(), text: matter.text.clone() })
    }

    /// This process has not run for so long: what was refused before is not over by that.
    pub fn stood_still(&mut self, now_ns: i64, stood_ns: i64) {
        for matter in &mut self.matters {
            for at_ns in [&mut matter.since_ns, &mut matter.last_ns] {
                *at_ns = without_standstill(*at_ns, now_ns, stood_ns);
            }
        }
    }

    fn forget(&mut self, now_ns: i64) {
        self.matters.retain(|matter| now_ns.saturating_sub(matter.last_ns) < OVER_NS);
    }
}

impl Matter {
    fn name(&self) -> String {
        match self.source.as_str() {
            "" => self.reason.to_owned(),
            source => format!("{} {source}", self.reason),
        }
    }

    fn is_lasting(&self, now_ns: i64) -> bool {
        self.last_ns.saturating_sub(self.since_ns) >= MIN_LASTING_NS
            && now_ns.saturating_sub(self.last_ns) < OVER_NS
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    #[test]
    fn a_refusal_is_reported_only_while_it_persists() {
        let mut refusals = Refusals::default();
        refusals.add(0, "another-clock", || "a".to_owned());
        assert_eq!(refusals.lasting(0).count(), 0);
        refusals.add(S / 2, "another-clock", || "b".to_owned());
        refusals.add(S, "another-clock", || "c".to_owned());
        let warning = Warning { matter: "another-clock".to_owned(), text: "a".to_owned() };
        assert_eq!(refusals.lasting(S).collect::<Vec<_>>(), [warning]);
        assert_eq!(refusals.lasting(3 * S).count(), 0);
        refusals.add(3 * S, "another-clock", || "d".to_owned());
        assert_eq!(refusals.lasting(3 * S).count(), 0, "it begins again");
    }

    #[test]
    fn a_refusal_is_not_over_by_a_standstill_of_this_process() {
        let mut refusals = Refusals::default();
        for at_ns in [0, S / 2, S] {
            refusals.add(at_ns, "another-clock", || "a".to_owned());
        }
        refusals.stood_still(21 * S, 20 * S);
        assert_eq!(refusals.lasting(21 * S).count(), 1);
        assert_eq!(refusals.lasting(23 * S).count(), 0);
    }

    #[test]
    fn one_reason_of_several_detectors_is_reported_for_each() {
        let mut refusals = Refusals::default();
        for at_ns in [0, S / 2, S] {
            for source in ["one", "other"] {
                refusals.add_of(at_ns, "impossible-marker", source, || source.to_owned());
            }
        }
        let reported: Vec<_> = refusals.lasting(S).map(|it| (it.matter, it.text)).collect();
        let of = |source: &str| (format!("impossible-marker {source}"), source.to_owned());
        assert_eq!(reported, [of("one"), of("other")]);
    }
}
