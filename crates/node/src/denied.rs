//! Counts the denials of Zenoh: connections without a valid certificate, which may have ended before they showed one, or without any
//! rights, and messages that access control rejects.
//!
//! Zenoh 1.10 has no counter for these. It only logs them, below the level that is shown; this module reads
//! those log messages. `tests/denied.rs` fails when Zenoh words them differently.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::{Mutex, PoisonError};

use tracing::field::{Field, Visit};
use tracing::{Event, Level, Metadata, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::{Context, Filter};

/// The log target of access control.
pub const ACCESS_TARGET: &str = "zenoh::net::routing::interceptor::access_control";
/// The prefix of the log targets of TLS connections.
pub const CONNECTION_TARGET: &str = "zenoh_link_tls";
/// Maximum number of reasons that are counted separately, as a peer chooses its keys freely; there are three for each topic.
const MAX_REASONS: usize = 128;
/// The reason for all others.
const OTHER: &str = "denied: others";

static COUNTS: Mutex<BTreeMap<String, u64>> = Mutex::new(BTreeMap::new());

/// The denials since the last call: the number of times for each reason.
pub fn take() -> BTreeMap<String, u64> {
    let mut counts = COUNTS.lock().unwrap_or_else(PoisonError::into_inner);
    // The reasons are kept, so that their number stays below the limit.
    let since = counts.iter_mut().map(|(reason, times)| (reason.clone(), std::mem::take(times)));
    since.filter(|(_, times)| *times > 0).collect()
}

/// A log layer that counts denials.
pub(crate) struct DeniedCounter;

impl<S: Subscriber> Layer<S> for DeniedCounter {
    fn on_event(&self, event: &Event<'_>, _context: Context<'_, S>) {
        let mut message = Message(String::new());
        event.record(&mut message);
        let Some(reason) = reason(event.metadata(), &message.0) else { return };
        let mut counts = COUNTS.lock().unwrap_or_else(PoisonError::into_inner);
        let is_separate = counts.contains_key(&reason) || counts.len() < MAX_REASONS;
        *counts.entry(if is_separate { reason } else { OTHER.to_owned() }).or_insert(0) += 1;
    }
}

/// Passes the events that [`DeniedCounter`] reads, and no others.
pub(crate) struct DeniedFilter;

impl<S> Filter<S> for DeniedFilter {
    fn enabled(&self, metadata: &Metadata<'_>, _context: &Context<'_, S>) -> bool {
        is_relevant(metadata)
    }

    fn callsite_enabled(
        &self,
        metadata: &'static Metadata<'static>,
    ) -> tracing::subscriber::Interest {
        if is_relevant(metadata) {
            tracing::subscriber::Interest::always()
        } else {
            tracing::subscriber::Interest::never()
        }
    }
}

fn is_relevant(metadata: &Metadata<'_>) -> bool {
    let target = metadata.target();
    target == ACCESS_TARGET
        || target.starts_with(CONNECTION_TARGET) && *metadata.level() == Level::WARN
}

struct Message(String);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        if field.name() == "message" {
            // Writing to a string cannot fail.
            let _ = write!(self.0, "{value:?}");
        }
    }
}

fn reason(metadata: &Metadata<'_>, message: &str) -> Option<String> {
    if metadata.target() == ACCESS_TARGET {
        if is_without_rights(message) {
            return Some(
                "denied: a connection without rights, of another vehicle or revoked".into(),
            );
        }
        if is_precomputed(message) { None } else { denied_message(message) }
    } else {
        let reason = match is_broken(message) {
            true => "denied: a connection that ended before it showed a valid certificate",
            false => "denied: a connection without a valid certificate",
        };
        is_denied_connection(message).then(|| reason.to_owned())
    }
}

thread_local! {
    /// The key whose permissions Zenoh is caching on this thread.
    static CACHED_KEY: RefCell<Option<String>> = const { RefCell::new(None) };
}

/// Whether a message only reports a permission that Zenoh caches. When a key is first used, Zenoh logs a
/// heading, and then the permission of every action on it, as if each had been attempted; the liveliness
/// subscription, which is allowed to all roles, is the last one.
fn is_precomputed(message: &str) -> bool {
    CACHED_KEY.with_borrow_mut(|cached| {
        if let Some(rest) = message.strip_prefix("ACL (ingress): caching permissions for `") {
            *cached = rest.split('`').next().map(str::to_owned);
            return true;
        }
        let Some(key) = cached.as_deref() else { return false };
        let is_for_key = !message.starts_with("Using cached result")
            && message.rsplit_once(" on ").is_some_and(|(_, other)| other == key);
        if !is_for_key || message.contains("Declare Liveliness Subscriber (ingress)") {
            *cached = None;
        }
        is_for_key
    })
}

/// Parses `ZID on SUBJECT is unauthorized to Query (ingress) on KEY`, or `ZID is unauthorized ...` from the
/// cache. Outgoing messages are not counted: their sender is this process.
fn denied_message(message: &str) -> Option<String> {
    let (_subject, denial) = message.split_once(" is unauthorized to ")?;
    let (action, key) = denial.split_once(" (ingress) on ")?;
    Some(format!("denied: {} on {key}", action.to_lowercase()))
}

/// Whether a connection has a valid certificate, but of a holder that is not in the relay's list: the relay then
/// announces no other process to it, and none of its messages arrive that could be counted.
fn is_without_rights(message: &str) -> bool {
    message.contains(" did not match any configured ACL subject")
}

/// The listener logs the cause of every connection it rejects, with a hint at the limit on open files, which
/// is the one cause that is not a denial.
fn is_denied_connection(message: &str) -> bool {
    message.contains("Hint:") && !message.contains("Too many open files")
}

/// Whether a denied connection ended, or the client sent nothing more, before its certificate was checked: the link may have broken.
fn is_broken(message: &str) -> bool {
    let causes = [
        "handshake eof",
        "Timeout during TLS handshake",
        "Connection reset",
        "Broken pipe",
        "timed out",
    ];
    causes.iter().any(|cause| message.contains(cause))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_broken_connection_is_distinguished_from_one_without_a_certificate() {
        let hint = "Hint: increase the system open file limit.";
        for cause in
            ["tls handshake eof", "Timeout during TLS handshake", "Connection reset by peer"]
        {
            let message = format!("{cause}. {hint}");
            assert!(is_denied_connection(&message) && is_broken(&message), "{cause}");
        }
        for cause in ["invalid peer certificate: UnknownIssuer", "peer sent no certificates"] {
            assert!(!is_broken(&format!("{cause}. {hint}")), "{cause}");
        }
    }

    #[test]
    fn a_connection_is_denied_for_its_certificate() {
        let hint = "Hint: increase the system open file limit.";
        let unknown = format!("invalid peer certificate: UnknownIssuer. {hint}");
        assert!(is_denied_connection(&unknown));
        assert!(!is_denied_connection(&format!("Too many open files (os error 24). {hint}")));
        assert!(!is_denied_connection("Unable to set LINGER option"));
    }

    #[test]
    fn a_connection_of_an_unlisted_holder_is_denied() {
        let message = "d480 did not match any configured ACL subject. Default permission `Deny` will be applied on all messages";
        assert!(is_without_rights(message));
        assert!(!is_without_rights("Access control is enabled"));
    }

    #[test]
    fn permissions_that_are_only_cached_are_not_counted() {
        let key = "drone/detector/main/detections";
        let line = |action: &str, done: &str| {
            format!("d480 on detector is {done} to {action} (ingress) on {key}")
        };
        assert!(is_precomputed(&format!("ACL (ingress): caching permissions for `{key}` ...")));
        assert!(is_precomputed(&line("Query", "unauthorized")));
        assert!(is_precomputed(&line("Put", "authorized")));
        assert!(is_precomputed(&line("Declare Liveliness Subscriber", "authorized")));
        assert!(!is_precomputed(&line("Query", "unauthorized")));
        assert!(is_precomputed(&format!("ACL (ingress): caching permissions for `{key}` ...")));
        assert!(!is_precomputed(
            "d480 on detector is unauthorized to Put (ingress) on drone/truth"
        ));
        assert!(!is_precomputed(&line("Query", "unauthorized")));
    }

    #[test]
    fn only_incoming_messages_are_counted() {
        let cases = [
            (
                "d480 on detector is unauthorized to Query (ingress) on drone/controller/command",
                Some("denied: query on drone/controller/command"),
            ),
            (
                "Using cached result: d480 is unauthorized to Put (ingress) on drone/truth",
                Some("denied: put on drone/truth"),
            ),
            ("d480 on detector is authorized to Put (ingress) on drone/truth", None),
            ("d480 on detector is unauthorized to Put (egress) on drone/truth", None),
        ];
        for (message, reason) in cases {
            assert_eq!(denied_message(message).as_deref(), reason, "{message}");
        }
    }
}
