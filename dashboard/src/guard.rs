//! Decides which clients may open the page, read and command: by address, headers and token.
//!
//! A web site that the operator has open in another tab can make the browser send requests to this machine. It cannot
//! hide its origin, nor, when its name resolves to this machine (DNS rebinding), its name: both are compared with the address
//! of the page. A request to an IP address or to `localhost` was not rebound.

use std::net::{IpAddr, SocketAddr};

use crate::config::Commands;
use crate::tokens::Kind;

/// The reason for refusing a request.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// The `Host` header is not of this page.
    Host,
    /// The `Origin` header is of another site.
    Origin,
    /// There is no token, or none that is valid.
    Token,
    /// There are too many browsers.
    Full,
    /// The page is encrypted, and the request was not.
    Plain,
}

impl Refusal {
    /// A short reason, which is counted in the health of the service.
    pub fn reason(self) -> &'static str {
        match self {
            Self::Host => "wrong Host",
            Self::Origin => "wrong Origin",
            Self::Token => "no valid token",
            Self::Full => "too many browsers",
            Self::Plain => "request without TLS",
        }
    }

    /// The reason as a sentence with the remedy.
    pub fn sentence(self) -> &'static str {
        match self {
            Self::Host => {
                "This page is not served under that name. Open it by its IP address, or add the name to `names` in the configuration of the dashboard."
            }
            Self::Origin => "Another web site asked for this, and only the page itself may.",
            Self::Token => {
                "A token is needed: run `alight dashboard token` on the machine of the dashboard."
            }
            Self::Full => {
                "As many browsers as `max_clients` allows are open already; close one of them."
            }
            Self::Plain => "This page is encrypted: open its address with https://.",
        }
    }
}

/// Compares requests with the address of the page.
#[derive(Clone, Debug)]
pub struct Guard {
    listen: SocketAddr,
    names: Vec<String>,
    commands: Commands,
    is_encrypted: bool,
}

/// The reason for which a page may not command where a token would permit it.
const NEEDS_TOKEN: &str = "a token for commands is needed: `alight dashboard token --kind command`";

/// The rights of a connection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Access {
    /// The reason for which it may not command; `None` when it may.
    pub no_commands: Option<&'static str>,
    /// Whether a token for commands would permit it to command.
    pub needs_token: bool,
}

impl Guard {
    /// A guard of the page at this address, which has these names as well, and is encrypted or not.
    pub fn new(
        listen: SocketAddr,
        names: Vec<String>,
        commands: Commands,
        is_encrypted: bool,
    ) -> Self {
        Self { listen, names, commands, is_encrypted }
    }

    /// The beginning of the page's address.
    pub fn scheme(&self) -> &'static str {
        if self.is_encrypted { "https://" } else { "http://" }
    }

    /// Checks that a request is for this page, and not from another site.
    ///
    /// # Errors
    /// The header that is wrong.
    pub fn check_headers(&self, host: Option<&str>, origin: Option<&str>) -> Result<(), Refusal> {
        let host = host.filter(|host| self.is_of_page(host)).ok_or(Refusal::Host)?;
        // Browsers send the origin with every WebSocket and every POST; other programs send none.
        let Some(origin) = origin else { return Ok(()) };
        let is_same =
            origin.strip_prefix(self.scheme()).is_some_and(|it| it.eq_ignore_ascii_case(host));
        if is_same { Ok(()) } else { Err(Refusal::Origin) }
    }

    fn is_of_page(&self, host: &str) -> bool {
        let (name, port) = match host.rsplit_once(':') {
            // The colons of an IPv6 address are inside of brackets.
            Some((name, port)) if !port.contains(']') => (name, port.parse().ok()),
            _ => (host, Some(if self.is_encrypted { 443 } else { 80 })),
        };
        if port != Some(self.listen.port()) {
            return false;
        }
        let listen = self.listen.ip();
        let bare = name.strip_prefix('[').and_then(|it| it.strip_suffix(']')).unwrap_or(name);
        if let Ok(address) = bare.parse::<IpAddr>() {
            return address == listen || listen.is_unspecified();
        }
        let is_here = name.eq_ignore_ascii_case("localhost");
        (is_here && (listen.is_loopback() || listen.is_unspecified()))
            || self.names.iter().any(|it| it.eq_ignore_ascii_case(name))
    }

    /// The rights of a connection from this address with a session of this kind.
    ///
    /// # Errors
    /// When it may not even read.
    pub fn access(&self, peer: IpAddr, session: Option<Kind>) -> Result<Access, Refusal> {
        let is_here = peer.to_canonical().is_loopback();
        if !is_here && session.is_none() {
            return Err(Refusal::Token);
        }
        let no_commands = match self.commands {
            Commands::Never => Some(
                "this page only shows; `commands = \"here\"` in its configuration lets it command",
            ),
            _ if !is_here && !self.is_encrypted => Some(
                "commands are taken on the machine of the dashboard only, as this connection is not encrypted; give the page a certificate (`alight dashboard certificate`), or bring it to your machine with `ssh -L`",
            ),
            Commands::Here if !is_here => Some(
                "commands are taken on the machine of the dashboard only; `commands = \"token\"` in its configuration takes them from elsewhere",
            ),
            Commands::Here => None,
            Commands::Token if session == Some(Kind::Command) => None,
            Commands::Token => Some(NEEDS_TOKEN),
        };
        Ok(Access { no_commands, needs_token: no_commands == Some(NEEDS_TOKEN) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn guard(listen: &str) -> Guard {
        Guard::new(listen.parse().unwrap(), vec!["kestrel.local".into()], Commands::Here, false)
    }

    #[test]
    fn only_the_pages_own_names_are_answered() {
        let local = guard("127.0.0.1:8080");
        for host in ["127.0.0.1:8080", "localhost:8080", "LOCALHOST:8080", "kestrel.local:8080"] {
            assert_eq!(local.check_headers(Some(host), None), Ok(()), "{host}");
        }
        for host in
            ["evil.example:8080", "127.0.0.1", "127.0.0.1:80", "10.0.0.1:8080", "[::1]:8080", ""]
        {
            assert_eq!(local.check_headers(Some(host), None), Err(Refusal::Host), "{host}");
        }
        assert_eq!(local.check_headers(None, None), Err(Refusal::Host));
        let open = guard("0.0.0.0:80");
        for host in ["10.0.0.1", "10.0.0.1:80", "[::1]", "localhost"] {
            assert_eq!(open.check_headers(Some(host), None), Ok(()), "{host}");
        }
        assert_eq!(open.check_headers(Some("rebound.example"), None), Err(Refusal::Host));
        assert_eq!(guard("[::1]:8080").check_headers(Some("[::1]:8080"), None), Ok(()));
    }

    #[test]
    fn only_the_pages_own_origin_is_answered() {
        let local = guard("127.0.0.1:8080");
        let check = |origin| local.check_headers(Some("localhost:8080"), Some(origin));
        assert_eq!(check("http://localhost:8080"), Ok(()));
        for origin in
            ["http://evil.example", "null", "https://localhost:8080", "http://127.0.0.1:8080"]
        {
            assert_eq!(check(origin), Err(Refusal::Origin), "{origin}");
        }
    }

    #[test]
    fn reading_is_free_here_and_needs_a_token_elsewhere() {
        let guard = guard("0.0.0.0:8080");
        let here = "127.0.0.1".parse().unwrap();
        let mapped = "::ffff:127.0.0.1".parse().unwrap();
        let away = "10.0.0.7".parse().unwrap();
        for peer in [here, mapped] {
            assert_eq!(
                guard.access(peer, None),
                Ok(Access { no_commands: None, needs_token: false })
            );
        }
        assert_eq!(guard.access(away, None), Err(Refusal::Token));
        // A token for commands that crossed the air in the clear commands nothing.
        let shown = guard.access(away, Some(Kind::Command)).unwrap();
        assert!(shown.no_commands.unwrap().contains("not encrypted"));
    }

    #[test]
    fn an_encrypted_page_takes_commands_from_elsewhere_with_a_token() {
        let open = |commands| Guard { commands, is_encrypted: true, ..guard("0.0.0.0:8080") };
        let away = "10.0.0.7".parse().unwrap();
        assert_eq!(open(Commands::Token).access(away, None), Err(Refusal::Token));
        let may = |commands, kind| open(commands).access(away, Some(kind)).unwrap().no_commands;
        assert_eq!(may(Commands::Token, Kind::Command), None);
        for (commands, kind) in [
            (Commands::Token, Kind::Monitor),
            (Commands::Here, Kind::Command),
            (Commands::Never, Kind::Command),
        ] {
            assert!(may(commands, kind).is_some(), "{commands:?} {kind}");
        }
        let page = open(Commands::Token);
        let check = |origin| page.check_headers(Some("localhost:8080"), Some(origin));
        assert_eq!(check("https://localhost:8080"), Ok(()));
        assert_eq!(check("http://localhost:8080"), Err(Refusal::Origin));
        let usual = Guard { is_encrypted: true, ..guard("0.0.0.0:443") };
        assert_eq!(usual.check_headers(Some("10.0.0.1"), None), Ok(()));
    }

    #[test]
    fn commands_are_taken_as_configured() {
        let here = "::1".parse().unwrap();
        let with = |commands| Guard { commands, ..guard("127.0.0.1:8080") };
        let may = |commands, session| with(commands).access(here, session).unwrap().no_commands;
        assert!(may(Commands::Never, Some(Kind::Command)).is_some());
        assert!(may(Commands::Here, None).is_none());
        assert!(may(Commands::Token, None).is_some());
        assert!(may(Commands::Token, Some(Kind::Monitor)).is_some());
        assert!(may(Commands::Token, Some(Kind::Command)).is_none());
    }

    #[test]
    fn a_page_asks_for_a_token_only_where_one_lets_it_command() {
        let here = "127.0.0.1".parse().unwrap();
        let away = "10.0.0.7".parse().unwrap();
        let needs = |commands, peer, session| {
            let guard = Guard { commands, ..guard("0.0.0.0:8080") };
            guard.access(peer, session).unwrap().needs_token
        };
        assert!(needs(Commands::Token, here, None));
        assert!(needs(Commands::Token, here, Some(Kind::Monitor)));
        assert!(!needs(Commands::Token, here, Some(Kind::Command)));
        // Over a network without encryption no token is sufficient.
        assert!(!needs(Commands::Token, away, Some(Kind::Monitor)));
        assert!(!needs(Commands::Here, here, None));
        assert!(!needs(Commands::Never, here, None));
    }
}
