//! Who sends a command, as its recipient logs it.
//!
//! With keys it is the holder of the certificate, else the user. Nothing proves it: whoever may command can send any name.

use std::path::Path;

use crate::clock::host_name;
use crate::identity::Identity;
use crate::key_pair;

/// Maximum length of a name, in bytes; a longer one ends there.
const MAX_LEN: usize = 160;
/// Variables of the environment that name the user.
const USER: [&str; 2] = ["USER", "LOGNAME"];

/// The name of this process as a sender: `operator.anna@drone, alight command-4711 on laptop`.
pub(crate) fn name(identity: &Identity, certificate: Option<&Path>) -> String {
    let holder = certificate.and_then(|path| key_pair::common_name(path).ok());
    let user = || USER.iter().find_map(|name| std::env::var(name).ok()).filter(|it| !it.is_empty());
    let who = holder.or_else(user).unwrap_or_else(|| "somebody".to_owned());
    let Identity { service, instance } = identity;
    shown(format!("{who}, {service} {instance} on {}", host_name()).as_bytes())
}

/// A sender's name as it came, without what a terminal or a log would take for its own.
pub(crate) fn shown(name: &[u8]) -> String {
    let text = String::from_utf8_lossy(name.get(..MAX_LEN).unwrap_or(name));
    let shown: String = text.chars().filter(|character| !character.is_control()).collect();
    if shown.trim().is_empty() { "a sender without a name".to_owned() } else { shown }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_short_and_one_line() {
        let identity = Identity { service: "alight", instance: "command-7".to_owned() };
        let own = name(&identity, None);
        assert!(own.ends_with(&format!(", alight command-7 on {}", host_name())), "{own}");
        assert_eq!(shown(own.as_bytes()), own);
        assert_eq!(shown(b"anna\n2026 INFO Landed\x1b[2J\x00"), "anna2026 INFO Landed[2J");
        assert_eq!(shown("\u{e4}".repeat(1000).as_bytes()).len(), MAX_LEN);
        for none in [&b""[..], b"\r\n", b" "] {
            assert_eq!(shown(none), "a sender without a name");
        }
        assert!(!shown(&[0xff; 3]).is_empty());
    }
}
