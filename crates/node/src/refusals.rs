//! What Zenoh refuses: connections without the right certificate, and messages that access control denies.
//!
//! Zenoh tells of them in its log only, below the level that is shown; they are picked out there.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::{Mutex, PoisonError};

use tracing::field::{Field, Visit};
use tracing::{Event, Level, Metadata, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::{Context, Filter};

/// Where Zenoh tells of messages.
const ACCESS: &str = "zenoh::net::routing::interceptor::access_control";
/// Where it tells of connections.
const CONNECTIONS: &str = "zenoh_link_tls";
/// Reasons that are kept apart; more are counted as one, so that nobody can fill the memory with keys.
const MOST_REASONS: usize = 64;
/// The reason for all others.
const OTHERS: &str = "refused: others";

static COUNTS: Mutex<BTreeMap<String, u64>> = Mutex::new(BTreeMap::new());

/// The refusals since the last call, by reason.
pub fn take() -> BTreeMap<String, u64> {
    let mut counts = COUNTS.lock().unwrap_or_else(PoisonError::into_inner);
    // The reasons stay, so that there are never more of them than the limit.
    let since = counts.iter_mut().map(|(reason, times)| (reason.clone(), std::mem::take(times)));
    since.filter(|(_, times)| *times > 0).collect()
}

/// Counts refusals.
pub(crate) struct Refusals;

impl<S: Subscriber> Layer<S> for Refusals {
    fn on_event(&self, event: &Event<'_>, _context: Context<'_, S>) {
        let mut message = Message(String::new());
        event.record(&mut message);
        let Some(reason) = reason(event.metadata(), &message.0) else { return };
        let mut counts = COUNTS.lock().unwrap_or_else(PoisonError::into_inner);
        let known = counts.contains_key(&reason) || counts.len() < MOST_REASONS;
        *counts.entry(if known { reason } else { OTHERS.to_owned() }).or_insert(0) += 1;
    }
}

/// Lets through what [`Refusals`] looks at, and nothing else.
pub(crate) struct OnlyRefusals;

impl<S> Filter<S> for OnlyRefusals {
    fn enabled(&self, metadata: &Metadata<'_>, _context: &Context<'_, S>) -> bool {
        is_watched(metadata)
    }

    fn callsite_enabled(
        &self,
        metadata: &'static Metadata<'static>,
    ) -> tracing::subscriber::Interest {
        if is_watched(metadata) {
            tracing::subscriber::Interest::always()
        } else {
            tracing::subscriber::Interest::never()
        }
    }
}

fn is_watched(metadata: &Metadata<'_>) -> bool {
    let target = metadata.target();
    target == ACCESS || target.starts_with(CONNECTIONS) && *metadata.level() == Level::WARN
}

struct Message(String);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        if field.name() == "message" {
            // Writing to a string does not fail.
            let _ = write!(self.0, "{value:?}");
        }
    }
}

fn reason(metadata: &Metadata<'_>, message: &str) -> Option<String> {
    if metadata.target() == ACCESS {
        if is_foresight(message) { None } else { refused_message(message) }
    } else {
        refused_connection(message)
            .then(|| "refused: a connection without a valid certificate".to_owned())
    }
}

thread_local! {
    /// The key for which Zenoh works out in advance, on this thread, what would be denied.
    static FORESEEN: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// When a key is first used, Zenoh looks up all that could be done with it, and tells of each as if it had been tried.
/// It says so before, and the subscription to presence, which everybody may have, comes last.
fn is_foresight(message: &str) -> bool {
    FORESEEN.with_borrow_mut(|foreseen| {
        if let Some(rest) = message.strip_prefix("ACL (ingress): caching permissions for `") {
            *foreseen = rest.split('`').next().map(str::to_owned);
            return true;
        }
        let Some(key) = foreseen.as_deref() else { return false };
        let is_of_it = !message.starts_with("Using cached result")
            && message.rsplit_once(" on ").is_some_and(|(_, of)| of == key);
        if !is_of_it || message.contains("Declare Liveliness Subscriber (ingress)") {
            *foreseen = None;
        }
        is_of_it
    })
}

/// `ZID on SUBJECT is unauthorized to Query (ingress) on KEY`, or `ZID is unauthorized ...` from the cache. Only what
/// comes in is somebody's fault.
fn refused_message(message: &str) -> Option<String> {
    let (_who, what) = message.split_once(" is unauthorized to ")?;
    let (action, key) = what.split_once(" (ingress) on ")?;
    Some(format!("refused: {} on {key}", action.to_lowercase()))
}

/// The listener says of every connection it does not take why, with a hint at the one cause that is nobody's fault.
fn refused_connection(message: &str) -> bool {
    message.contains("Hint:") && !message.contains("Too many open files")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_connection_is_refused_for_its_certificate() {
        let hint = "Hint: increase the system open file limit.";
        assert!(refused_connection(&format!("invalid peer certificate: UnknownIssuer. {hint}")));
        assert!(!refused_connection(&format!("Too many open files (os error 24). {hint}")));
        assert!(!refused_connection("Unable to set LINGER option"));
    }

    #[test]
    fn what_is_looked_up_in_advance_was_not_tried() {
        let key = "drone/detector/main/detections";
        let line = |action: &str, done: &str| {
            format!("d480 on detector is {done} to {action} (ingress) on {key}")
        };
        assert!(is_foresight(&format!("ACL (ingress): caching permissions for `{key}` ...")));
        assert!(is_foresight(&line("Query", "unauthorized")));
        assert!(is_foresight(&line("Put", "authorized")));
        assert!(is_foresight(&line("Declare Liveliness Subscriber", "authorized")));
        assert!(!is_foresight(&line("Query", "unauthorized")));
        assert!(is_foresight(&format!("ACL (ingress): caching permissions for `{key}` ...")));
        assert!(!is_foresight("d480 on detector is unauthorized to Put (ingress) on drone/truth"));
        assert!(!is_foresight(&line("Query", "unauthorized")));
    }

    #[test]
    fn what_comes_in_and_is_denied_is_a_refusal() {
        let cases = [
            (
                "d480 on detector is unauthorized to Query (ingress) on drone/controller/command",
                Some("refused: query on drone/controller/command"),
            ),
            (
                "Using cached result: d480 is unauthorized to Put (ingress) on drone/truth",
                Some("refused: put on drone/truth"),
            ),
            ("d480 on detector is authorized to Put (ingress) on drone/truth", None),
            ("d480 on detector is unauthorized to Put (egress) on drone/truth", None),
        ];
        for (message, reason) in cases {
            assert_eq!(refused_message(message).as_deref(), reason, "{message}");
        }
    }
}
