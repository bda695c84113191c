//! A nonce for each command: it is asked for when the button goes down, and spent when it was held long enough.
//!
//! So a command cannot be repeated, cannot come late, and cannot be given by a touch.

/// Minimum time from a nonce to its command, in nanoseconds; the page holds for a second.
const MIN_HELD_NS: i64 = 900_000_000;
/// Maximum time from a nonce to its command, in nanoseconds: a second of holding, and two for the way.
const MAX_LIFE_NS: i64 = 3_000_000_000;

/// Why a command is refused before the controller hears of it.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum NonceProblem {
    /// No nonce was asked for, it is spent, or it is another one.
    Unknown,
    /// It was asked for another command.
    Mismatch,
    /// It was asked for too short a time ago.
    Early,
    /// It was asked for too long ago.
    Late,
}

impl NonceProblem {
    /// A short reason, which is counted in the health of the service.
    pub fn reason(self) -> &'static str {
        match self {
            Self::Unknown => "command without a valid nonce",
            Self::Mismatch => "nonce of another command",
            Self::Early => "command not held for a second",
            Self::Late => "late command",
        }
    }

    /// For people.
    pub fn sentence(self) -> &'static str {
        match self {
            Self::Unknown => "it was sent twice, or its nonce is not of this connection",
            Self::Mismatch => "its nonce is of another command",
            Self::Early => "it was not held for 1 s",
            Self::Late => "it came more than 3 s after the button went down",
        }
    }
}

/// The open nonce of a connection. A new one takes its place.
#[derive(Clone, Debug, Default)]
pub struct Nonce {
    open: Option<Open>,
}

#[derive(Clone, Debug)]
struct Open {
    text: String,
    command: String,
    at_ns: i64,
}

impl Nonce {
    /// Opens a nonce, made of fresh random bytes, for a command with its argument.
    pub fn open(&mut self, now_ns: i64, random: [u8; 16], command: &str) -> String {
        let text: String = random.iter().map(|byte| format!("{byte:02x}")).collect();
        self.open = Some(Open { text: text.clone(), command: command.to_owned(), at_ns: now_ns });
        text
    }

    /// Spends the nonce, whether it is right or not.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn spend(&mut self, now_ns: i64, text: &str, command: &str) -> Result<(), NonceProblem> {
        let open = self.open.take().filter(|open| open.text == text);
        let open = open.ok_or(NonceProblem::Unknown)?;
        let held_ns = now_ns.saturating_sub(open.at_ns);
        match () {
            () if open.command != command => Err(NonceProblem::Mismatch),
            () if held_ns < MIN_HELD_NS => Err(NonceProblem::Early),
            () if held_ns > MAX_LIFE_NS => Err(NonceProblem::Late),
            () => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: i64 = 1_000_000_000;

    #[test]
    fn a_command_is_held_for_a_second_and_given_once() {
        let mut nonce = Nonce::default();
        let text = nonce.open(0, [7; 16], "hold");
        assert_eq!(nonce.spend(SECOND, &text, "hold"), Ok(()));
        assert_eq!(nonce.spend(SECOND, &text, "hold"), Err(NonceProblem::Unknown));
    }

    #[test]
    fn what_is_early_late_or_of_another_command_is_refused_and_spent() {
        for (at, command, problem) in [
            (SECOND / 2, "hold", NonceProblem::Early),
            (4 * SECOND, "hold", NonceProblem::Late),
            (SECOND, "abort", NonceProblem::Mismatch),
        ] {
            let mut nonce = Nonce::default();
            let text = nonce.open(0, [7; 16], "hold");
            assert_eq!(nonce.spend(at, &text, command), Err(problem));
            assert_eq!(nonce.spend(SECOND, &text, "hold"), Err(NonceProblem::Unknown));
        }
        let mut nonce = Nonce::default();
        let first = nonce.open(0, [7; 16], "hold");
        nonce.open(0, [8; 16], "hold");
        assert_eq!(nonce.spend(SECOND, &first, "hold"), Err(NonceProblem::Unknown));
    }
}
