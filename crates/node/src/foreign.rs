//! Whether a program that is none of ours answers where a session connects. Zenoh tries such an address again for ever, without a word.

use std::io;
use std::time::Duration;

use anyhow::bail;
use serde_json::Value;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::oneshot;
use tokio::time::{Instant, timeout, timeout_at};

use crate::boxed::BoxFuture;

/// Maximum time for which the start of a session waits for answers: a process on this machine gives one within milliseconds.
const AT_START: Duration = Duration::from_millis(300);
/// Time after which an address at which somebody accepts connections, and says nothing, is told.
const PATIENCE: Duration = Duration::from_secs(3);
/// Pause before an address is tried again at which a connection was closed without an answer, as a process does that ends.
const PAUSE: Duration = Duration::from_millis(200);
/// Bytes of an answer that are read.
const ANSWER_BYTES: usize = 64;

/// The first message of a Zenoh client that wants to connect (INIT), with its length before it. Its name, which may be any
/// bytes, is two ends of a line: servers of lines of text, such as web servers, then answer at once.
const GREETING: [u8; 9] = [7, 0, 0x01, 0x09, 0x32, b'\r', b'\n', b'\r', b'\n'];
/// The answer that accepts: INIT with the flag A. The upper two bits say what follows in it.
const INIT_ACK: u8 = 0x21;
/// It is shorter than this: two letters, taken for its length, are more.
const MAX_INIT_ACK: u16 = 4096;
/// The answer that refuses: CLOSE, which is shorter than what TLS says to who does not speak it.
const CLOSE: u8 = 0x03;
const MAX_CLOSE: u16 = 16;

/// What answers at an address.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Answer {
    /// Nobody, or a process that speaks Zenoh.
    Fine,
    /// Another program, with the beginning of what it says.
    Foreign(String),
    /// Somebody accepts connections and says nothing: another program, or one of ours that stands still.
    Silence,
}

/// Where a session connects.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Contact {
    /// `127.0.0.1:7447`.
    address: String,
    /// Whether the processes of this machine meet there; else it is the other side of a link.
    is_rendezvous: bool,
}

/// Refuses a session that would connect to another program. What is found out later is logged.
///
/// # Errors
/// Names the port, what answers there, and what to do.
pub(crate) fn refuse(config: &zenoh::Config) -> BoxFuture<'static, anyhow::Result<()>> {
    let contacts = contacts(&config.get_json("connect/endpoints").unwrap_or_default());
    Box::pin(async move {
        let start = Instant::now() + AT_START;
        // All are asked before the first answer is awaited.
        let answers: Vec<_> = contacts.into_iter().map(ask).collect();
        for mut answer in answers {
            if let Ok(Ok(Some(problem))) = timeout_at(start, &mut answer).await {
                bail!(problem);
            }
        }
        Ok(())
    })
}

/// The addresses of a configuration's endpoints for connections without encryption: a list, or one for each mode. Who greets
/// an encrypted one without a certificate is counted there as an intruder.
fn contacts(endpoints: &str) -> Vec<Contact> {
    let endpoints: Value = serde_json::from_str(endpoints).unwrap_or_default();
    let of_modes = endpoints.as_object().into_iter().flat_map(|modes| modes.values());
    let texts = of_modes.chain([&endpoints]).filter_map(Value::as_array).flatten();
    texts.filter_map(Value::as_str).filter_map(Contact::of).collect()
}

/// Asks in a task of its own. The receiver hears the problem; when nobody waits any more it is logged.
fn ask(contact: Contact) -> oneshot::Receiver<Option<String>> {
    let (sender, receiver) = oneshot::channel();
    tokio::spawn(async move {
        let problem = contact.problem(&answer(&contact.address).await);
        if let Err(Some(problem)) = sender.send(problem) {
            tracing::warn!("{problem}");
        }
    });
    receiver
}

/// Greets until there is an answer, or patience ends.
async fn answer(address: &str) -> Answer {
    let end = Instant::now() + PATIENCE;
    loop {
        match timeout_at(end, greet(address)).await {
            Ok(Ok(answer)) => return answer,
            Ok(Err(_closed)) if Instant::now() + PAUSE < end => tokio::time::sleep(PAUSE).await,
            Ok(Err(_)) | Err(_) => return Answer::Silence,
        }
    }
}

/// The answer to one greeting.
///
/// # Errors
/// When the connection is closed without an answer.
async fn greet(address: &str) -> io::Result<Answer> {
    // An address out of reach takes longer than the patience, and is nobody either.
    let Ok(Ok(mut stream)) = timeout(PATIENCE - PAUSE, TcpStream::connect(address)).await else {
        return Ok(Answer::Fine);
    };
    stream.write_all(&GREETING).await?;
    let mut answer = [0; ANSWER_BYTES];
    let mut len = 0;
    // The length of a message and its first byte.
    while len < 3 {
        match stream.read(answer.get_mut(len..).unwrap_or_default()).await? {
            0 => break,
            more => len += more,
        }
    }
    let said = answer.get(..len).unwrap_or_default();
    let is_zenoh = match *said {
        [] => return Err(io::ErrorKind::UnexpectedEof.into()),
        [low, high, kind, ..] => match u16::from_le_bytes([low, high]) {
            length if kind & 0x3f == INIT_ACK => length < MAX_INIT_ACK,
            length => kind & 0x1f == CLOSE && length < MAX_CLOSE,
        },
        _ => false,
    };
    Ok(if is_zenoh { Answer::Fine } else { Answer::Foreign(beginning(said)) })
}

/// The beginning of an answer for people.
fn beginning(said: &[u8]) -> String {
    let is_text = |byte: &&u8| byte.is_ascii_graphic() || **byte == b' ';
    let text: Vec<u8> = said.iter().take_while(is_text).copied().collect();
    match String::from_utf8(text) {
        Ok(text) if text.len() > 3 => format!("`{text}`"),
        _ => format!("{} bytes that are no text", said.len()),
    }
}

impl Contact {
    /// `tcp/127.0.0.1:7447`, or `tcp/10.42.0.1:7448?prio=1-4#dscp=0xb8`: each connection of the air link has settings.
    fn of(endpoint: &str) -> Option<Self> {
        let text = endpoint.strip_prefix("tcp/")?;
        let address = text.split(['?', '#']).next()?.to_owned();
        let is_local = ["127.", "localhost:", "[::1]:"].iter().any(|it| text.starts_with(it));
        Some(Self { is_rendezvous: is_local && address == text, address })
    }

    /// What is wrong with an answer, and what to do.
    fn problem(&self, answer: &Answer) -> Option<String> {
        let Self { address, is_rendezvous } = self;
        let port = address.rsplit(':').next().unwrap_or_default();
        let place = match is_rendezvous {
            true => format!("port {port} of this machine, where its processes meet ({address})"),
            false => format!("{address}, where this process is to connect"),
        };
        let remedy = match is_rendezvous {
            true => format!(
                "`ss -ltnp 'sport = :{port}'` names it; end it, or have all processes of this machine meet at another port: \
                 `--meet PORT`, `meet` of the site, or ALIGHT_MEET"
            ),
            false => format!(
                "`ss -ltnp 'sport = :{port}'` on that machine names it; end it, or correct the address: `--connect`, `address` or \
                 `relay_address` of the site, or ALIGHT_CONNECT"
            ),
        };
        match answer {
            Answer::Fine => None,
            Answer::Foreign(said) => Some(format!(
                "another program listens at {place}: it does not speak Zenoh, but answers {said}. {remedy}"
            )),
            Answer::Silence => Some(format!(
                "Somebody listens at {place}, and has not answered for {} s, so this process meets no other: it is another \
                 program, or one of Alight that stands still. {remedy}",
                PATIENCE.as_secs()
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::net::TcpListener;

    /// Says this to everybody who connects, once they have said something, and closes the connection; or keeps it and says
    /// nothing.
    async fn listener(says: Option<&'static [u8]>) -> String {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap().to_string();
        tokio::spawn(async move {
            let mut kept = Vec::new();
            while let Ok((mut stream, _)) = listener.accept().await {
                match says {
                    Some(says) => {
                        let mut greeting = [0; GREETING.len()];
                        stream.read_exact(&mut greeting).await.unwrap();
                        stream.write_all(says).await.unwrap();
                    }
                    None => kept.push(stream),
                }
            }
        });
        address
    }

    #[tokio::test]
    async fn an_answer_tells_zenoh_from_other_programs() {
        let foreign = |said: &str| Answer::Foreign(said.to_owned());
        let answers: [(&'static [u8], Answer); 7] = [
            (b"\x09\x00\x21\x09\x31abcd\x00\x00", Answer::Fine),
            (b"\x02\x00\xe1", Answer::Fine),
            (b"\x02\x00\x03\x01", Answer::Fine),
            (b"HTTP/1.0 400 Bad Request\r\n\r\n", foreign("`HTTP/1.0 400 Bad Request`")),
            (b"Mail for you\r\n", foreign("`Mail for you`")),
            (b"SSH-2.0-OpenSSH_9.2\r\n", foreign("`SSH-2.0-OpenSSH_9.2`")),
            (b"\x15\x03\x03\x00\x02\x02\x16", foreign("7 bytes that are no text")),
        ];
        for (says, expected) in answers {
            assert_eq!(answer(&listener(Some(says)).await).await, expected, "{says:?}");
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn zenoh_answers_the_greeting() {
        let ([port], _, _) = testing::ports::free().unwrap();
        let config = crate::session::local_config(port);
        let config = zenoh::Config::from_json5(&config).unwrap();
        let _session = zenoh::open(config).await.unwrap();
        let address = format!("127.0.0.1:{port}");
        TcpStream::connect(&address).await.expect("it listens");
        assert_eq!(greet(&address).await.unwrap(), Answer::Fine);
    }

    #[tokio::test]
    async fn who_closes_or_says_nothing_is_silent_and_nobody_is_fine() {
        let begun = Instant::now();
        let [closes, keeps] = [listener(Some(b"")).await, listener(None).await];
        let (closes, keeps) = tokio::join!(answer(&closes), answer(&keeps));
        assert_eq!([closes, keeps], [Answer::Silence, Answer::Silence]);
        assert!(begun.elapsed() < PATIENCE + Duration::from_secs(2), "{:?}", begun.elapsed());
        let nobody = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
        assert_eq!(answer(&nobody.to_string()).await, Answer::Fine);
    }

    #[test]
    fn only_connections_without_encryption_are_asked() {
        let found = |text| contacts(text).into_iter().map(|it| it.address).collect::<Vec<_>>();
        let list =
            r#"["tcp/10.0.0.1:7448?prio=1-4#dscp=0xb8", "tls/10.0.0.1:7449", "tcp/[::1]:7#a=b"]"#;
        assert_eq!(found(list), ["10.0.0.1:7448", "[::1]:7"]);
        assert_eq!(found(r#"{"peer": ["tcp/a:1"], "client": ["tcp/b:2"]}"#), ["b:2", "a:1"]);
        assert!(found("").is_empty() && found("null").is_empty());
    }

    #[test]
    fn a_problem_names_the_port_and_what_to_do() {
        let told = |endpoint: &str, answer| Contact::of(endpoint).unwrap().problem(&answer);
        let here = told("tcp/127.0.0.1:7447", Answer::Foreign("`HTTP`".to_owned())).unwrap();
        for part in ["port 7447 of this machine", "answers `HTTP`", "ss -ltnp", "--meet PORT"] {
            assert!(here.contains(part), "`{part}` is not in: {here}");
        }
        // A tunnel has its end here as well.
        for endpoint in ["tcp/10.0.0.1:7448", "tcp/127.0.0.1:7448?prio=5-6"] {
            let there = told(endpoint, Answer::Silence).unwrap();
            for part in ["0.0.1:7448, where", "3 s", "on that machine", "--connect"] {
                assert!(there.contains(part), "`{part}` is not in: {there}");
            }
        }
        assert_eq!(told("tcp/127.0.0.1:7447", Answer::Fine), None);
    }
}
