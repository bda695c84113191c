//! Encodes protocol buffers, as far as recordings need them: tables of message types, which describe a type in a file
//! (`FileDescriptorSet`) and encode their fields.
//!
//! Reference: the wire format and `descriptor.proto` of Protocol Buffers, version 3.

/// A message type.
#[derive(Debug)]
pub struct MessageType {
    /// Its full name, as `foxglove.Log`.
    pub name: &'static str,
    /// Its fields.
    pub fields: &'static [Field],
    /// Its enumerations.
    pub enums: &'static [&'static EnumType],
}

/// An enumeration within a message type.
#[derive(Debug)]
pub struct EnumType {
    /// Its name within the message type.
    pub name: &'static str,
    /// Names and numbers of its values.
    pub values: &'static [Value],
}

/// A value of an enumeration.
#[derive(Debug)]
pub struct Value {
    /// Its name.
    pub name: &'static str,
    /// Its number.
    pub number: u64,
}

/// A field of a message type.
#[derive(Debug)]
pub struct Field {
    /// Its name.
    pub name: &'static str,
    /// Its number.
    pub number: u32,
    /// The type of its value.
    pub kind: Kind,
    /// Whether it is a list of such values.
    pub is_repeated: bool,
}

/// The type of a field's value.
#[derive(Debug)]
pub enum Kind {
    /// A float of 64 bits.
    Double,
    /// An unsigned number of 32 bits, of fixed length.
    Fixed32,
    /// A signed number of 64 bits, of variable length.
    Int64,
    /// A signed number of 32 bits, of variable length.
    Int32,
    /// UTF-8 text.
    Text,
    /// Bytes.
    Bytes,
    /// A message.
    Message(&'static MessageType),
    /// An enumeration of the same message type.
    Enum(&'static EnumType),
}

impl Kind {
    /// `FieldDescriptorProto.Type`.
    fn number(&self) -> u64 {
        match self {
            Self::Double => 1,
            Self::Int64 => 3,
            Self::Int32 => 5,
            Self::Fixed32 => 7,
            Self::Text => 9,
            Self::Message(_) => 11,
            Self::Bytes => 12,
            Self::Enum(_) => 14,
        }
    }
}

/// The bytes of one message.
#[derive(Clone, Debug, Default)]
pub struct Encoder {
    bytes: Vec<u8>,
}

impl Encoder {
    /// The encoded message.
    pub fn finish(self) -> Vec<u8> {
        self.bytes
    }

    /// Adds a number of variable length.
    #[must_use]
    pub fn varint(mut self, field: u32, value: u64) -> Self {
        self.tag(field, 0);
        self.raw_varint(value);
        self
    }

    /// Adds a float.
    #[must_use]
    pub fn double(mut self, field: u32, value: f64) -> Self {
        self.tag(field, 1);
        self.bytes.extend_from_slice(&value.to_le_bytes());
        self
    }

    /// Adds floats, packed.
    #[must_use]
    pub fn doubles(self, field: u32, values: &[f64]) -> Self {
        let packed: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.bytes(field, &packed)
    }

    /// Adds a number of 32 bits of fixed length.
    #[must_use]
    pub fn fixed32(mut self, field: u32, value: u32) -> Self {
        self.tag(field, 5);
        self.bytes.extend_from_slice(&value.to_le_bytes());
        self
    }

    /// Adds bytes.
    #[must_use]
    pub fn bytes(mut self, field: u32, value: &[u8]) -> Self {
        self.tag(field, 2);
        self.raw_varint(value.len() as u64);
        self.bytes.extend_from_slice(value);
        self
    }

    /// Adds text.
    #[must_use]
    pub fn text(self, field: u32, value: &str) -> Self {
        self.bytes(field, value.as_bytes())
    }

    /// Adds a message.
    #[must_use]
    pub fn message(self, field: u32, value: Self) -> Self {
        self.bytes(field, &value.bytes)
    }

    /// Adds messages.
    #[must_use]
    pub fn messages(self, field: u32, values: impl IntoIterator<Item = Self>) -> Self {
        values.into_iter().fold(self, |all, value| all.message(field, value))
    }

    fn tag(&mut self, field: u32, wire_type: u64) {
        self.raw_varint(u64::from(field) << 3 | wire_type);
    }

    fn raw_varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.bytes.push((value & 0x7f) as u8 | 0x80);
            value >>= 7;
        }
        self.bytes.push(value as u8);
    }
}

/// The contents of the first field of an encoded message that has this number and holds bytes, text or a message; `None` where there
/// is none before the message ends or is cut.
pub fn bytes_of(message: &[u8], field: u32) -> Option<&[u8]> {
    let mut rest = message;
    loop {
        let (tag, after) = varint(rest)?;
        let length = match tag & 7 {
            0 => after.len() - varint(after)?.1.len(),
            1 => 8,
            5 => 4,
            2 => {
                let (length, contents) = varint(after)?;
                let (contents, after) = contents.split_at_checked(usize::try_from(length).ok()?)?;
                if tag >> 3 == u64::from(field) {
                    return Some(contents);
                }
                rest = after;
                continue;
            }
            _ => return None,
        };
        rest = after.get(length..)?;
    }
}

/// A number of variable length, and the bytes after it.
fn varint(bytes: &[u8]) -> Option<(u64, &[u8])> {
    let mut value = 0;
    for (index, byte) in bytes.iter().enumerate().take(10) {
        value |= u64::from(byte & 0x7f) << (7 * index);
        if byte & 0x80 == 0 {
            return Some((value, bytes.get(index + 1..)?));
        }
    }
    None
}

/// The `FileDescriptorSet` of a message type and of all that it contains.
pub fn descriptor_set(root: &'static MessageType) -> Vec<u8> {
    let mut types = Vec::new();
    collect(root, &mut types);
    let files = types.iter().map(|message| file(message));
    Encoder::default().messages(1, files).finish()
}

fn collect(message: &'static MessageType, found: &mut Vec<&'static MessageType>) {
    for field in message.fields {
        if let Kind::Message(inner) = field.kind {
            collect(inner, found);
        }
    }
    // The imports of a file come before it.
    if found.iter().all(|it| it.name != message.name) {
        found.push(message);
    }
}

/// The `FileDescriptorProto` of one message type: a separate file.
fn file(message: &MessageType) -> Encoder {
    let (package, name) = message.name.rsplit_once('.').unwrap_or(("", message.name));
    let mut imports: Vec<&str> = Vec::new();
    for field in message.fields {
        if let Kind::Message(inner) = field.kind
            && !imports.contains(&inner.name)
        {
            imports.push(inner.name);
        }
    }
    let path = |name: &str| format!("{}.proto", name.replace('.', "/"));
    let head = Encoder::default().text(1, &path(message.name)).text(2, package);
    let head = imports.iter().fold(head, |all, name| all.text(3, &path(name)));
    let fields = message.fields.iter().map(|it| field(message, it));
    let enums = message.enums.iter().map(|it| {
        let values = it
            .values
            .iter()
            .map(|value| Encoder::default().text(1, value.name).varint(2, value.number));
        Encoder::default().text(1, it.name).messages(2, values)
    });
    let body = Encoder::default().text(1, name).messages(2, fields).messages(4, enums);
    head.message(4, body).text(12, "proto3")
}

/// The `FieldDescriptorProto` of a field.
fn field(message: &MessageType, field: &Field) -> Encoder {
    const OPTIONAL: u64 = 1;
    const REPEATED: u64 = 3;
    let label = if field.is_repeated { REPEATED } else { OPTIONAL };
    let encoder = Encoder::default()
        .text(1, field.name)
        .varint(3, u64::from(field.number))
        .varint(4, label)
        .varint(5, field.kind.number());
    match field.kind {
        Kind::Message(inner) => encoder.text(6, &format!(".{}", inner.name)),
        Kind::Enum(inner) => encoder.text(6, &format!(".{}.{}", message.name, inner.name)),
        _ => encoder,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_and_text_are_encoded_as_the_specification_shows() {
        // The examples of the specification: field 1 = 150; field 2 = "testing".
        assert_eq!(Encoder::default().varint(1, 150).finish(), [0x08, 0x96, 0x01]);
        let testing = [0x12, 0x07, 0x74, 0x65, 0x73, 0x74, 0x69, 0x6e, 0x67];
        assert_eq!(Encoder::default().text(2, "testing").finish(), testing);
        let inner = Encoder::default().varint(1, 150);
        assert_eq!(Encoder::default().message(3, inner).finish(), [0x1a, 0x03, 0x08, 0x96, 0x01]);
    }

    #[test]
    fn bytes_are_found_behind_fields_of_every_kind_and_cut_messages_have_none() {
        let message = Encoder::default()
            .varint(1, 300)
            .double(2, 1.5)
            .fixed32(3, 7)
            .text(4, "no")
            .bytes(5, &[9; 200])
            .finish();
        assert_eq!(bytes_of(&message, 4), Some(&b"no"[..]));
        assert_eq!(bytes_of(&message, 5), Some(&[9; 200][..]));
        // Numbers are not bytes.
        assert_eq!(
            (bytes_of(&message, 1), bytes_of(&message, 3), bytes_of(&message, 6)),
            (None, None, None)
        );
        for length in 0..message.len() {
            assert_eq!(bytes_of(&message[..length], 5), None, "cut to {length} bytes");
        }
        assert_eq!(bytes_of(&[0xff; 30], 5), None);
    }
}
