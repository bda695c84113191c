//! Encodes messages into payloads and decodes them: [`encode`] and [`decode`].
//!
//! A payload is the letter `A`, the message's type, its version, and the postcard encoding of its fields.
//! Positional encodings break silently when a type changes; the version makes them break loudly.

use serde::Serialize;
use serde::de::DeserializeOwned;

/// A type that may be sent.
pub trait Message: Serialize + DeserializeOwned {
    /// The type's number on the wire; no two types share one.
    const TYPE: u8;
    /// Raised with every change of the type's fields.
    const VERSION: u8;
    /// The type's name, for error messages.
    const NAME: &'static str;

    /// The message as postcard writes it, for [`encode`] only. Each type has it and [`Message::read_body`] itself, so that its code is compiled here
    /// and not in every crate that sends it.
    ///
    /// # Errors
    /// When it has a sequence of unknown length.
    fn write_body(&self) -> postcard::Result<Vec<u8>>;

    /// The message at the beginning of some bytes, and the bytes after it.
    ///
    /// # Errors
    /// When the bytes are of another type, or too few.
    fn read_body(body: &[u8]) -> postcard::Result<(Self, &[u8])>;
}

/// First byte of every payload.
pub const MAGIC: u8 = b'A';

const HEADER_LEN: usize = 3;

/// Why a payload was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// Not an Alight payload.
    #[error("expected a {expected}, got {len} bytes that are not an Alight payload")]
    Foreign {
        /// Length in bytes.
        len: usize,
        /// The message that was expected.
        expected: &'static str,
    },
    /// A payload of another type.
    #[error("expected a {expected} (type {wanted}), got a payload of type {found}")]
    Type {
        /// The type found.
        found: u8,
        /// The type expected.
        wanted: u8,
        /// The message that was expected.
        expected: &'static str,
    },
    /// A payload of another version of the program.
    #[error(
        "{expected} has version {found}, this program expects version {wanted}; run the same version everywhere"
    )]
    Version {
        /// The version found.
        found: u8,
        /// The version expected.
        wanted: u8,
        /// The message that was expected.
        expected: &'static str,
    },
    /// Bytes that end too early or hold impossible values.
    #[error("a {expected} of {len} bytes is truncated or damaged: {cause}")]
    Damaged {
        /// Length in bytes.
        len: usize,
        /// The message that was expected.
        expected: &'static str,
        /// The invalid part, as text.
        cause: &'static str,
    },
    /// Bytes after the end of the message.
    #[error("a {expected} has {extra} bytes after its end")]
    Trailing {
        /// Surplus bytes.
        extra: usize,
        /// The message that was expected.
        expected: &'static str,
    },
}

impl DecodeError {
    /// A short name for the refusal counters.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Foreign { .. } => "foreign",
            Self::Type { .. } => "wrong type",
            Self::Version { .. } => "wrong version",
            Self::Damaged { .. } => "damaged",
            Self::Trailing { .. } => "trailing bytes",
        }
    }

    /// Why a message of a recording cannot be read, after the word "it": without the advice to run another version.
    pub fn in_recording(&self) -> String {
        match self {
            Self::Version { found, wanted, .. } => {
                format!("is of another version ({found}; this program reads {wanted})")
            }
            other => format!("cannot be read: {other}"),
        }
    }
}

/// The bytes of a message.
pub fn encode<M: Message>(message: &M) -> Vec<u8> {
    let mut bytes = vec![MAGIC, M::TYPE, M::VERSION];
    // Postcard fails only on sequences of unknown length, which no message has; were one to appear, the
    // receiver would refuse the header without a body.
    if let Ok(body) = message.write_body() {
        bytes.extend_from_slice(&body);
    }
    bytes
}

/// The message in some bytes.
///
/// # Errors
/// [`DecodeError`] when the bytes are not exactly one message of this type and version.
pub fn decode<M: Message>(bytes: &[u8]) -> Result<M, DecodeError> {
    let expected = M::NAME;
    let len = bytes.len();
    let &[MAGIC, found_type, found_version, ref body @ ..] = bytes else {
        return Err(DecodeError::Foreign { len, expected });
    };
    if found_type != M::TYPE {
        return Err(DecodeError::Type { found: found_type, wanted: M::TYPE, expected });
    }
    if found_version != M::VERSION {
        return Err(DecodeError::Version { found: found_version, wanted: M::VERSION, expected });
    }
    let (message, rest) = M::read_body(body).map_err(|error| {
        let cause = error_text(&error);
        DecodeError::Damaged { len: len.max(HEADER_LEN), expected, cause }
    })?;
    match rest.len() {
        0 => Ok(message),
        extra => Err(DecodeError::Trailing { extra, expected }),
    }
}

/// Why postcard could not read a message, as text.
fn error_text(error: &postcard::Error) -> &'static str {
    use postcard::Error;
    match error {
        Error::DeserializeUnexpectedEnd => "it ends before its last field",
        Error::DeserializeBadVarint => "a number in it has too many bytes",
        Error::DeserializeBadBool => "a true or false in it is neither 0 nor 1",
        Error::DeserializeBadUtf8 => "a string in it is not UTF-8",
        Error::DeserializeBadOption => "an option in it is neither 0 nor 1",
        _ => "a variant or another value in it does not exist",
    }
}

/// Gives types their numbers and versions on the wire.
macro_rules! wire {
    ($($type:ty = $number:literal v $version:literal;)*) => {$(
        impl $crate::codec::Message for $type {
            const TYPE: u8 = $number;
            const VERSION: u8 = $version;
            const NAME: &'static str = stringify!($type);

            fn write_body(&self) -> postcard::Result<Vec<u8>> {
                postcard::to_stdvec(self)
            }

            fn read_body(body: &[u8]) -> postcard::Result<(Self, &[u8])> {
                postcard::take_from_bytes(body)
            }
        }
    )*};
}
pub(crate) use wire;
