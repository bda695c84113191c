//! Decides which clients may follow a flight, by the origin that a browser states for the page.
//!
//! Any web site that is open in a browser can connect to this machine. It cannot hide its origin; programs other than
//! browsers have none.

use std::net::IpAddr;

/// Whether a client may follow: no page of a browser, one of this machine or of the address that is requested, or one of `allowed`.
pub(crate) fn may_follow(origin: Option<&str>, host: Option<&str>, allowed: &[String]) -> bool {
    let Some(origin) = origin else { return true };
    if allowed.iter().any(|it| it.eq_ignore_ascii_case(origin)) {
        return true;
    }
    let Some(page) = origin.strip_prefix("http://") else { return false };
    let name = without_port(page);
    if name.eq_ignore_ascii_case("localhost") {
        return true;
    }
    // A name may be one that points here for a moment; an address is not.
    name.parse::<IpAddr>().is_ok_and(|it| it.is_loopback() || host == Some(page))
}

/// The name or address in front of a port, without the brackets of an IPv6 address.
fn without_port(text: &str) -> &str {
    let name = match text.rsplit_once(':') {
        Some((name, port)) if !port.contains(']') => name,
        _ => text,
    };
    name.strip_prefix('[').and_then(|it| it.strip_suffix(']')).unwrap_or(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_of_other_sites_are_refused() {
        let allowed = ["https://app.example".to_owned(), "file://".to_owned()];
        let may = |origin| may_follow(Some(origin), Some("10.0.0.7:8765"), &allowed);
        assert!(may_follow(None, None, &[]));
        for origin in [
            "https://app.example",
            "file://",
            "http://localhost:8080",
            "http://127.0.0.1",
            "http://[::1]:9000",
            "http://10.0.0.7:8765",
        ] {
            assert!(may(origin), "{origin}");
        }
        for origin in [
            "https://evil.example",
            "http://evil.example:8765",
            "http://10.0.0.8:8765",
            "http://localhost.evil.example",
            "https://localhost.evil.example",
            "null",
            "",
        ] {
            assert!(!may(origin), "{origin}");
        }
        // A name that points here for a moment asks for itself.
        let rebound = "evil.example:8765";
        assert!(!may_follow(Some("http://evil.example:8765"), Some(rebound), &allowed));
    }
}
