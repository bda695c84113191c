//! Stores tokens for browsers on other machines in a file, as hashes with their expiry, and the sessions by cookie of browsers
//! that have presented one.

use std::collections::BTreeMap;
use std::fmt;
use std::io::Write;
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::{Context, ensure};
use serde::Deserialize;
use sha2::{Digest, Sha256};

/// Random bytes of a token and of a session.
const RANDOM_BYTES: usize = 32;
/// Maximum number of tokens in a file; the oldest is removed.
const MAX_TOKENS: usize = 64;
/// Maximum size of the file, in bytes.
const MAX_FILE_BYTES: u64 = 65_536;
/// Maximum number of sessions of one token; the one of this token that ends first is removed, and none of another token.
const MAX_SESSIONS: usize = 64;
/// A token that is missing for this time was removed, in nanoseconds: an editor may replace a file in two steps.
const MISSING_NS: i64 = 2_000_000_000;
/// A file that cannot be read for this time ends all sessions, in nanoseconds, as a token may have been removed. A system that
/// is out of file handles for a while does not end the control of a landing.
const UNREADABLE_NS: i64 = 60_000_000_000;
/// Duration of a session, in seconds.
pub const SESSION_S: u64 = 12 * 3600;

/// The right that a token gives.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// To view.
    Monitor,
    /// To command.
    Command,
}

impl FromStr for Kind {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        node::named(text)
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Monitor => "monitor",
            Self::Command => "command",
        })
    }
}

/// A secret that cannot be guessed, as text.
///
/// # Errors
/// When the system has no random numbers.
pub fn secret() -> anyhow::Result<String> {
    let mut bytes = [0; RANDOM_BYTES];
    getrandom::fill(&mut bytes).context("asking the system for random numbers")?;
    Ok(hex(&bytes))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The hash of a secret. One round is enough, as 256 random bits cannot be guessed.
fn hash(secret: &str) -> String {
    hex(&Sha256::digest(secret.as_bytes()))
}

/// A token, without its secret.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Token {
    /// The right that it gives.
    pub kind: Kind,
    hash: String,
    /// In seconds since 1970.
    expires_s: u64,
}

/// The tokens of a file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Tokens {
    tokens: Vec<Token>,
}

impl Tokens {
    /// Reads a file from which tokens are accepted; there are none before it exists.
    ///
    /// # Errors
    /// When others may read it, or it is damaged.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let mode = std::fs::metadata(path).map_or(0, |file| file.permissions().mode() & 0o777);
        ensure!(
            mode & 0o077 == 0,
            "the tokens {path:?} are open to other users (mode {mode:o}): remove the file, and make new tokens"
        );
        Self::read_open(path)
    }

    /// Reads a file, also one that others may read: it still shows which tokens were removed.
    ///
    /// # Errors
    /// When it cannot be read, or is damaged.
    pub fn read_open(path: &Path) -> anyhow::Result<Self> {
        let file = match std::fs::metadata(path) {
            Ok(file) => file,
            Err(cause) if cause.kind() == std::io::ErrorKind::NotFound => {
                return Ok(Self::default());
            }
            Err(cause) => return Err(cause).with_context(|| format!("reading {path:?}")),
        };
        ensure!(file.len() <= MAX_FILE_BYTES, "{path:?} is larger than {MAX_FILE_BYTES} bytes");
        let text = std::fs::read_to_string(path).with_context(|| format!("reading {path:?}"))?;
        text.parse().map_err(anyhow::Error::msg).with_context(|| format!("reading {path:?}"))
    }

    /// Writes them to a file that only its owner reads, atomically, so that no reader gets half of it.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, path: &Path) -> anyhow::Result<()> {
        let folder = path.parent().filter(|folder| *folder != Path::new(""));
        if let Some(folder) = folder {
            let mut builder = std::fs::DirBuilder::new();
            builder.recursive(true).mode(0o700);
            builder.create(folder).with_context(|| format!("making the directory {folder:?}"))?;
        }
        let new = path.with_extension(format!("new-{}", std::process::id()));
        let mut options = std::fs::OpenOptions::new();
        let mut file = options
            .write(true)
            .create_new(true)
            .mode(0o600)
            .open(&new)
            .with_context(|| format!("making {new:?}"))?;
        let written = file.write_all(self.to_string().as_bytes());
        written
            .and_then(|()| std::fs::rename(&new, path))
            .with_context(|| format!("writing {path:?}"))
    }

    /// Adds a token until a time in seconds since 1970, and removes those that have expired.
    pub fn add(&mut self, secret: &str, kind: Kind, now_s: u64, expires_s: u64) {
        self.tokens.retain(|token| token.expires_s > now_s);
        let surplus = (self.tokens.len() + 1).saturating_sub(MAX_TOKENS);
        self.tokens.drain(..surplus);
        self.tokens.push(Token { kind, hash: hash(secret), expires_s });
    }

    /// The token of a secret; `None` for one that is wrong or has expired.
    pub fn of(&self, secret: &str, now_s: u64) -> Option<&Token> {
        let hash = hash(secret.trim());
        // The duration of comparing hashes reveals nothing about the secret.
        let token = self.tokens.iter().find(|token| token.hash == hash);
        token.filter(|token| token.expires_s > now_s)
    }
}

impl fmt::Display for Tokens {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "# Tokens of the dashboard: kind, SHA-256, end in seconds since 1970. Remove a line to end one."
        )?;
        let mut tokens = self.tokens.iter();
        tokens.try_for_each(|t| writeln!(f, "{} {} {}", t.kind, t.hash, t.expires_s))
    }
}

impl FromStr for Tokens {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let mut tokens = Vec::new();
        let lines = text.lines().map(str::trim).filter(|l| !l.is_empty() && !l.starts_with('#'));
        for line in lines.take(MAX_TOKENS) {
            let parts: Vec<&str> = line.split_whitespace().collect();
            let [kind, hash, expires_s] = parts[..] else {
                return Err("a line is not KIND HASH END".to_owned());
            };
            let expires_s = expires_s.parse().map_err(|_| "an end is not a number".to_owned())?;
            tokens.push(Token { kind: kind.parse()?, hash: hash.to_owned(), expires_s });
        }
        Ok(Self { tokens })
    }
}

/// The usual file: in the user's state folder (`XDG_STATE_HOME`, or .local/state at home).
///
/// # Errors
/// When the environment names neither.
pub fn usual_file() -> anyhow::Result<PathBuf> {
    Ok(usual_folder()?.join("dashboard-tokens"))
}

/// The folder of a dashboard's files.
///
/// # Errors
/// When the environment names none.
pub fn usual_folder() -> anyhow::Result<PathBuf> {
    let named = |variable| std::env::var_os(variable).map(PathBuf::from);
    let state = named("XDG_STATE_HOME").filter(|path| path.is_absolute());
    let state = state.or_else(|| named("HOME").map(|home| home.join(".local").join("state")));
    let state = state.context("neither XDG_STATE_HOME nor HOME is set; set `tokens` in the configuration of the dashboard")?;
    Ok(state.join("alight"))
}

/// Browsers that have presented a token, in memory only, by the hash of their cookie.
#[derive(Clone, Debug, Default)]
pub struct Sessions {
    by_hash: BTreeMap<String, Session>,
}

#[derive(Clone, Debug)]
struct Session {
    token: Token,
    /// Its end, in nanoseconds of a monotonic clock: a wall clock that is set meanwhile does not end the control of a landing.
    ends_ns: i64,
    /// Time since which its token is not in the file, in nanoseconds of that clock.
    missing_ns: Option<i64>,
    /// Time since which the file cannot be read.
    unreadable_ns: Option<i64>,
}

impl Sessions {
    /// Begins a session with this cookie, no longer than its token is valid by the time in seconds since 1970. `now_ns` is, here and
    /// below, of a monotonic clock.
    pub fn begin(&mut self, cookie: &str, token: Token, now_s: u64, now_ns: i64) {
        self.by_hash.retain(|_, session| session.ends_ns > now_ns);
        let of_token = self.by_hash.iter().filter(|(_, session)| session.token == token);
        if of_token.clone().count() >= MAX_SESSIONS {
            let first = of_token.min_by_key(|(_, session)| session.ends_ns);
            let first = first.map(|(hash, _)| hash.clone());
            first.and_then(|hash| self.by_hash.remove(&hash));
        }
        let valid_s = token.expires_s.saturating_sub(now_s).min(SESSION_S);
        let ends_ns = now_ns.saturating_add(valid_s.cast_signed() * 1_000_000_000);
        let session = Session { token, ends_ns, missing_ns: None, unreadable_ns: None };
        self.by_hash.insert(hash(cookie), session);
    }

    /// The kind of the session of a cookie, until it ends.
    pub fn kind(&self, cookie: &str, now_ns: i64) -> Option<Kind> {
        let session = self.by_hash.get(&hash(cookie))?;
        (session.ends_ns > now_ns).then_some(session.token.kind)
    }

    /// Ends the sessions of tokens that are no longer in their file, and all sessions while the file cannot be read (`None`) for
    /// long; a short gap ends none.
    pub fn end_invalid(&mut self, tokens: Option<&Tokens>, now_ns: i64) {
        let persists = |since_ns: Option<i64>, for_ns| {
            since_ns.is_some_and(|since_ns| now_ns.saturating_sub(since_ns) >= for_ns)
        };
        self.by_hash.retain(|_, session| {
            match tokens.map(|it| it.tokens.contains(&session.token)) {
                Some(true) => (session.missing_ns, session.unreadable_ns) = (None, None),
                Some(false) => {
                    session.missing_ns.get_or_insert(now_ns);
                }
                None => {
                    session.unreadable_ns.get_or_insert(now_ns);
                }
            }
            !persists(session.missing_ns, MISSING_NS)
                && !persists(session.unreadable_ns, UNREADABLE_NS)
        });
    }

    /// Ends a session.
    pub fn end(&mut self, cookie: &str) {
        self.by_hash.remove(&hash(cookie));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_is_stored_as_a_hash_and_expires() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("state/tokens");
        assert_eq!(Tokens::read(&path).unwrap(), Tokens::default());
        let [look, fly] = [secret().unwrap(), secret().unwrap()];
        assert_ne!(look, fly);
        let mut tokens = Tokens::default();
        tokens.add(&look, Kind::Monitor, 10, 20);
        tokens.add(&fly, Kind::Command, 10, 30);
        tokens.write(&path).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(!text.contains(&look) && !text.contains(&fly), "{text}");
        let read = Tokens::read(&path).unwrap();
        assert_eq!(read, tokens);
        let kind = |secret: &str, now_s| read.of(secret, now_s).map(|token| token.kind);
        assert_eq!(kind(&look, 19), Some(Kind::Monitor));
        assert_eq!(kind(&format!("{fly}\n"), 19), Some(Kind::Command));
        assert_eq!(kind(&look, 20), None);
        assert_eq!(kind("wrong", 10), None);
        assert_eq!(kind("", 10), None);
        tokens.write(&path).unwrap();
    }

    #[test]
    fn a_file_that_others_read_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens");
        Tokens::default().write(&path).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o644)).unwrap();
        assert!(Tokens::read(&path).unwrap_err().to_string().contains("other users"));
        assert_eq!(Tokens::read_open(&path).unwrap(), Tokens::default());
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        std::fs::write(&path, "monitor only\n").unwrap();
        assert!(Tokens::read(&path).is_err());
    }

    #[test]
    fn sessions_end_with_their_time_and_their_token() {
        let token = |kind, expires_s: u64| Token { kind, hash: expires_s.to_string(), expires_s };
        let mut sessions = Sessions::default();
        let second = 1_000_000_000;
        // The time since 1970 counts at the log-in only: it may be set after it.
        sessions.begin("short", token(Kind::Monitor, 1060), 1000, 5 * second);
        assert_eq!(sessions.kind("short", 64 * second), Some(Kind::Monitor));
        assert_eq!(sessions.kind("short", 65 * second), None, "as its token");
        sessions.begin("a", token(Kind::Monitor, u64::MAX), 1000, 0);
        let end = SESSION_S.cast_signed() * second;
        assert_eq!(sessions.kind("a", end - 1), Some(Kind::Monitor));
        assert_eq!(sessions.kind("a", end), None);
        assert_eq!(sessions.kind("b", 0), None);
        sessions.end("a");
        assert_eq!(sessions.kind("a", 1), None);
    }

    #[test]
    fn log_ins_end_sessions_of_their_own_token_only() {
        let token = |kind, name: &str| Token { kind, hash: name.into(), expires_s: u64::MAX };
        let mut sessions = Sessions::default();
        sessions.begin("pilot", token(Kind::Command, "pilot"), 0, 0);
        sessions.begin("guest", token(Kind::Monitor, "guest"), 0, 0);
        for number in 0..1000 {
            sessions.begin(&number.to_string(), token(Kind::Monitor, "many"), 0, number);
        }
        assert_eq!(sessions.by_hash.len(), 2 + MAX_SESSIONS);
        assert_eq!(sessions.kind("pilot", 1000), Some(Kind::Command));
        assert_eq!(sessions.kind("guest", 1000), Some(Kind::Monitor));
        assert_eq!(sessions.kind("999", 1000), Some(Kind::Monitor));
        assert_eq!(sessions.kind("0", 1000), None);
    }

    #[test]
    fn a_removed_token_ends_its_sessions_and_a_file_that_is_unreadable_for_a_moment_none() {
        let token =
            |name: &str| Token { kind: Kind::Command, hash: name.into(), expires_s: u64::MAX };
        let mut begun = Sessions::default();
        begun.begin("one", token("one"), 0, 0);
        begun.begin("two", token("two"), 0, 0);
        let open = |sessions: &Sessions| ["one", "two"].map(|it| sessions.kind(it, 0).is_some());
        let both = Tokens { tokens: vec![token("one"), token("two")] };
        let second = Tokens { tokens: vec![token("two")] };

        let mut sessions = begun.clone();
        sessions.end_invalid(Some(&Tokens::default()), 0);
        sessions.end_invalid(Some(&both), MISSING_NS);
        sessions.end_invalid(Some(&second), 2 * MISSING_NS);
        assert_eq!(open(&sessions), [true; 2]);
        sessions.end_invalid(Some(&second), 3 * MISSING_NS);
        assert_eq!(open(&sessions), [false, true]);

        // A removed token stays removed when the file cannot be read afterwards.
        let mut sessions = begun.clone();
        sessions.end_invalid(Some(&second), 0);
        sessions.end_invalid(None, MISSING_NS);
        assert_eq!(open(&sessions), [false, true]);

        let mut sessions = begun;
        sessions.end_invalid(None, 0);
        sessions.end_invalid(None, UNREADABLE_NS - 1);
        assert_eq!(open(&sessions), [true; 2]);
        sessions.end_invalid(Some(&both), UNREADABLE_NS);
        sessions.end_invalid(None, 2 * UNREADABLE_NS);
        assert_eq!(open(&sessions), [true; 2]);
        sessions.end_invalid(None, 3 * UNREADABLE_NS);
        assert_eq!(open(&sessions), [false; 2]);
    }
}
