//! Issues a nonce for each command: it is requested when the button is pressed, and spent once the button was held long enough.
//!
//! So a command cannot be repeated, cannot arrive late, and cannot be given by a brief touch.

/// Minimum time from a nonce to its command, in nanoseconds; the page holds for a second.
const MIN_HELD_NS: i64 = 900_000_000;
/// Maximum time from a nonce to its command, in nanoseconds: a second of holding, and two for the transmission.
const MAX_LIFE_NS: i64 = 3_000_000_000;

/// The reason for refusing a command before it is sent to the controller.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum NonceError {
    /// No nonce was requested, it is spent, or it is a different one.
    Unknown,
    /// It was requested for another command.
    Mismatch,
    /// It was requested too recently.
    Early,
    /// It was requested too long ago.
    Late,
}

impl NonceError {
    /// A short reason, which is counted in the health of the service.
    pub fn reason(self) -> &'static str {
        match self {
            Self::Unknown => "command without a valid nonce",
            Self::Mismatch => "nonce of another command",
            Self::Early => "command not held for a second",
            Self::Late => "late command",
        }
    }

    /// The reason as a sentence for the operator.
    pub fn sentence(self) -> &'static str {
        match self {
            Self::Unknown => "it was sent twice, or its nonce is not of this connection",
            Self::Mismatch => "its nonce is of another command",
            Self::Early => "it was not held for 1 s",
            Self::Late => "it arrived more than 3 s after the button was pressed",
        }
    }
}

/// The open nonce of a connection. A new one replaces it.
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

    /// Spends the nonce, whether it is valid or not.
    ///
    /// # Errors
    /// The reason for which it is not valid.
    pub fn spend(&mut self, now_ns: i64, text: &str, command: &str) -> Result<(), NonceError> {
        let open = self.open.take().filter(|open| open.text == text);
        let open = open.ok_or(NonceError::Unknown)?;
        let held_ns = now_ns.saturating_sub(open.at_ns);
        match () {
            () if open.command != command => Err(NonceError::Mismatch),
            () if held_ns < MIN_HELD_NS => Err(NonceError::Early),
            () if held_ns > MAX_LIFE_NS => Err(NonceError::Late),
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
        assert_eq!(nonce.spend(SECOND, &text, "hold"), Err(NonceError::Unknown));
    }

    #[test]
    fn an_early_or_late_nonce_or_one_of_another_command_is_refused_and_spent() {
        for (at, command, error) in [
            (SECOND / 2, "hold", NonceError::Early),
            (4 * SECOND, "hold", NonceError::Late),
            (SECOND, "abort", NonceError::Mismatch),
        ] {
            let mut nonce = Nonce::default();
            let text = nonce.open(0, [7; 16], "hold");
            assert_eq!(nonce.spend(at, &text, command), Err(error));
            assert_eq!(nonce.spend(SECOND, &text, "hold"), Err(NonceError::Unknown));
        }
        let mut nonce = Nonce::default();
        let first = nonce.open(0, [7; 16], "hold");
        nonce.open(0, [8; 16], "hold");
        assert_eq!(nonce.spend(SECOND, &first, "hold"), Err(NonceError::Unknown));
    }
}
