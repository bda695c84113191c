//! Names the sender of a command, as its recipient logs it.
//!
//! With keys it is the holder of the certificate, else the user. It is not authenticated: each client that may command can send any name.

use std::path::Path;

use crate::certificate;
use crate::clock::host_name;
use crate::identity::Identity;

/// Maximum number of letters of a name; a longer one ends there.
const MAX_LETTERS: usize = 160;
/// Variables of the environment that name the user.
const USER: [&str; 2] = ["USER", "LOGNAME"];

/// The name of this process as a sender: `operator.anna@drone, alight command-4711 on laptop`.
pub(crate) fn name(identity: &Identity, own: Option<&Path>) -> String {
    let holder = own.and_then(|path| certificate::certificate(path).ok());
    let holder = holder.map(|it| it.common_name).filter(|it| !it.is_empty());
    let user = || USER.iter().find_map(|name| std::env::var(name).ok()).filter(|it| !it.is_empty());
    let user = holder.or_else(user).unwrap_or_else(|| "somebody".to_owned());
    let Identity { service, instance } = identity;
    let name = format!("{user}, {service} {instance} on {}", host_name());
    // It is a parameter of a selector, and must not contain a selector's separators.
    let is_plain = |it: char| it.is_alphanumeric() || " .,@_-".contains(it);
    shown(&name.replace(|it| !is_plain(it), "_"))
}

/// A name from the network, shortened and without control characters.
pub(crate) fn shown(name: &str) -> String {
    let letters = name.chars().filter(|character| !character.is_control());
    let shown: String = letters.take(MAX_LETTERS).collect();
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
        assert_eq!(shown(&own), own);
        let odd = Identity { service: "alight", instance: "a;b=c?d\ne".to_owned() };
        assert!(name(&odd, None).contains("alight a_b_c_d_e on "), "{}", name(&odd, None));
        assert_eq!(shown("anna\n2026 INFO Landed\x1b[2J\0"), "anna2026 INFO Landed[2J");
        assert_eq!(shown(&"\u{e4}".repeat(1000)).chars().count(), MAX_LETTERS);
        for none in ["", "\r\n", " "] {
            assert_eq!(shown(none), "a sender without a name");
        }
    }
}
