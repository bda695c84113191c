//! Probes, with Zenoh's greeting, the unencrypted addresses to which a session connects: a tool is refused where only other programs
//! answer; a service logs it and continues. Zenoh retries such an address for ever without a log message; the service connects
//! once the right program is there.

use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use anyhow::bail;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::oneshot;
use tokio::time::{Instant, timeout, timeout_at};

use crate::boxed::BoxFuture;
use crate::endpoint::{self, Endpoint};

/// Maximum time for which the start of a tool waits for answers: a process on this machine gives one within milliseconds.
const AT_START: Duration = Duration::from_millis(300);
/// Time after which an address is reported at which a program accepts connections and sends nothing: shorter than a tool waits.
const TIMEOUT: Duration = Duration::from_secs(2);
/// Pause before an address is tried again at which a connection was closed without an answer, as a process does that ends.
const PAUSE: Duration = Duration::from_millis(200);
/// Bytes of an answer that are read.
const ANSWER_BYTES: usize = 64;

/// The first message of a Zenoh client that wants to connect (INIT), with its length before it. Its name, which may be any
/// bytes, is two ends of a line: servers of lines of text, such as web servers, then answer at once.
pub(crate) const GREETING: [u8; 9] = [7, 0, 0x01, 0x09, 0x32, b'\r', b'\n', b'\r', b'\n'];
/// The answer that accepts: INIT with the flag A. The upper two bits show the optional parts.
const INIT_ACK: u8 = 0x21;
/// It is shorter than this: two letters, taken for its length, are more.
const MAX_INIT_ACK: u16 = 4096;
/// The answer that refuses: CLOSE, which is shorter than the alert of TLS to a client without TLS.
const CLOSE: u8 = 0x03;
const MAX_CLOSE: u16 = 16;
/// The answer of a relay with keys to a client without TLS: the beginning of an alert.
const TLS_ALERT: [u8; 2] = [0x15, 0x03];

/// The program at an address, by its answer.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Answer {
    /// No program, or a process that speaks Zenoh.
    Fine,
    /// A program that speaks TLS, as a relay with keys does.
    Encrypted,
    /// Another program, with the beginning of its answer.
    Foreign(String),
    /// A program accepts connections and sends nothing: another program, or a stopped process of Alight.
    Silence,
}

/// An address to which a session connects.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Contact {
    /// `127.0.0.1:7447`.
    address: SocketAddr,
    /// Whether it is the rendezvous of this machine; else it is the other side of a link.
    is_rendezvous: bool,
}

/// All addresses to which a session connects.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Contacts {
    /// The addresses that are probed. Names are not: the system may take long to resolve them, and delays the end of the process.
    /// Encrypted addresses are not: a greeting without a certificate is counted there as a denied connection.
    asked: Vec<Contact>,
    /// Whether there are others.
    has_others: bool,
}

/// Refuses the session of a tool when other programs answer at all addresses to which it connects. Later answers, and errors
/// at some of several addresses, are logged.
///
/// # Errors
/// Names the port, the program that answers there, and a remedy.
pub(crate) fn refuse(config: &zenoh::Config) -> BoxFuture<'static, anyhow::Result<()>> {
    let Contacts { asked, has_others } = Contacts::of(config);
    Box::pin(async move {
        let start = Instant::now() + AT_START;
        let count = asked.len();
        // All are probed before the first answer is awaited.
        let answers: Vec<_> = asked.into_iter().map(ask).collect();
        let mut problems = Vec::new();
        for mut answer in answers {
            if let Ok(Ok(Some(problem))) = timeout_at(start, &mut answer).await {
                problems.push(problem);
            }
        }
        match problems.first() {
            Some(first) if problems.len() == count && !has_others => bail!("{first}"),
            _ => {
                log(&problems);
                Ok(())
            }
        }
    })
}

/// Logs errors at the addresses to which a service connects, in parallel with its start.
pub(crate) fn watch(config: &zenoh::Config) {
    let answers: Vec<_> = Contacts::of(config).asked.into_iter().map(ask).collect();
    tokio::spawn(async move {
        let mut problems = Vec::new();
        for answer in answers {
            problems.extend(answer.await.ok().flatten());
        }
        log(&problems);
    });
}

/// Logs only the first error: the ports of a relay all have the same one.
fn log(problems: &[String]) {
    if let Some(first) = problems.first() {
        tracing::error!("Zenoh cannot connect: {first}");
    }
}

/// Probes in a separate task. The receiver gets the error; without a receiver it is logged.
fn ask(contact: Contact) -> oneshot::Receiver<Option<String>> {
    let (sender, receiver) = oneshot::channel();
    tokio::spawn(async move {
        let problem = contact.problem(&answer(contact.address).await);
        if let Err(Some(problem)) = sender.send(problem) {
            log(&[problem]);
        }
    });
    receiver
}

/// Greets until there is an answer, or until the timeout.
async fn answer(address: SocketAddr) -> Answer {
    let end = Instant::now() + TIMEOUT;
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
async fn greet(address: SocketAddr) -> io::Result<Answer> {
    // An unreachable address takes longer than the timeout, and has no program either.
    let Ok(Ok(mut stream)) = timeout(TIMEOUT - PAUSE, TcpStream::connect(address)).await else {
        return Ok(Answer::Fine);
    };
    answer_on(&mut stream).await
}

/// The answer to a greeting on a connection.
///
/// # Errors
/// When it is closed without an answer.
async fn answer_on(stream: &mut TcpStream) -> io::Result<Answer> {
    // The system may choose the destination port as the local port: then no program listens there.
    if stream.local_addr()? == stream.peer_addr()? {
        return Ok(Answer::Fine);
    }
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
    Ok(match is_zenoh {
        true => Answer::Fine,
        false if said.starts_with(&TLS_ALERT) => Answer::Encrypted,
        false => Answer::Foreign(beginning(said)),
    })
}

/// The beginning of an answer, as text.
fn beginning(said: &[u8]) -> String {
    let is_text = |byte: &&u8| byte.is_ascii_graphic() || **byte == b' ';
    let text: Vec<u8> = said.iter().take_while(is_text).copied().collect();
    match String::from_utf8(text) {
        Ok(text) if text.len() > 3 => format!("`{text}`"),
        _ => format!("{} bytes that are no text", said.len()),
    }
}

impl Contacts {
    fn of(config: &zenoh::Config) -> Self {
        let part = |key| config.get_json(key).unwrap_or_default();
        Self::parse(&part("mode"), &part("connect/endpoints"))
    }

    /// The addresses of a mode and endpoints as JSON: a list, or one for each mode.
    fn parse(mode: &str, endpoints: &str) -> Self {
        let mut contacts = Self::default();
        for endpoint in endpoint::connected(mode, endpoints) {
            match Contact::of(&endpoint) {
                // Several connections may have one address.
                Some(contact) if contacts.asked.contains(&contact) => {}
                Some(contact) => contacts.asked.push(contact),
                None => contacts.has_others = true,
            }
        }
        contacts
    }
}

impl Contact {
    /// `tcp/127.0.0.1:7447`, or `tcp/10.42.0.1:7448?prio=1-4#dscp=0xb8`: each connection of the air link has settings.
    fn of(endpoint: &str) -> Option<Self> {
        let endpoint = Endpoint::parse(endpoint).filter(|it| it.protocol == "tcp")?;
        let address = format!("{}:{}", endpoint.host, endpoint.port).parse().ok()?;
        Some(Self { is_rendezvous: endpoint.is_rendezvous(), address })
    }

    /// The error of an answer, with a remedy.
    fn problem(&self, answer: &Answer) -> Option<String> {
        let Self { address, is_rendezvous } = self;
        let port = address.port();
        let place = match is_rendezvous {
            true => format!("port {port} of this machine, where its processes meet ({address})"),
            false => format!("{address}, to which this process is to connect"),
        };
        let elsewhere = "have all processes of this machine meet at another port: by the endpoints of the file where `--zenoh` names \
                         one, else by `--meet PORT`, `meet` of the site, or ALIGHT_MEET";
        let correct = "correct the address: `--connect`, `address` or `relay_address` of the site, or ALIGHT_CONNECT";
        let remedy = match is_rendezvous {
            true => format!("`ss -ltnp 'sport = :{port}'` names it; end it, or {elsewhere}"),
            false => {
                format!(
                    "`ss -ltnp 'sport = :{port}'` on that machine names it; end it, or {correct}"
                )
            }
        };
        match answer {
            Answer::Fine => None,
            Answer::Encrypted if *is_rendezvous => Some(format!(
                "the program that listens at {place} speaks TLS, as a relay with keys does, but the processes of a machine meet without TLS: {elsewhere}"
            )),
            Answer::Encrypted => Some(format!(
                "the program that listens at {place}, wants keys, and this process has none: give it those of the vehicle with `--keys DIRECTORY`, \
                 `keys` of the site, or ALIGHT_KEYS; where it is no relay of yours, {correct}"
            )),
            Answer::Foreign(said) => Some(format!(
                "another program listens at {place}: it does not speak Zenoh, but answers {said}. {remedy}"
            )),
            Answer::Silence => Some(format!(
                "a program listens at {place}, and has not answered for {} s: another program, or a stopped process of Alight; \
                 this process cannot connect there. {remedy}",
                TIMEOUT.as_secs()
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::net::TcpListener;

    /// Sends this to each client after its first bytes, and closes the connection; or keeps it open and sends
    /// nothing.
    async fn listener(says: Option<&'static [u8]>) -> SocketAddr {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
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
    async fn an_answer_distinguishes_zenoh_from_other_programs() {
        let foreign = |said: &str| Answer::Foreign(said.to_owned());
        let answers: [(&'static [u8], Answer); 8] = [
            (b"\x09\x00\x21\x09\x31abcd\x00\x00", Answer::Fine),
            (b"\x02\x00\xe1", Answer::Fine),
            (b"\x02\x00\x03\x01", Answer::Fine),
            (b"HTTP/1.0 400 Bad Request\r\n\r\n", foreign("`HTTP/1.0 400 Bad Request`")),
            (b"Mail for you\r\n", foreign("`Mail for you`")),
            (b"SSH-2.0-OpenSSH_9.2\r\n", foreign("`SSH-2.0-OpenSSH_9.2`")),
            (b"\x15\x03\x03\x00\x02\x02\x16", Answer::Encrypted),
            (b"\x00\x03\x03\x00\x02\x02\x16", foreign("7 bytes that are no text")),
        ];
        for (says, expected) in answers {
            assert_eq!(answer(listener(Some(says)).await).await, expected, "{says:?}");
        }
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn zenoh_answers_the_greeting() {
        let ([port], _, _) = testing::ports::free().unwrap();
        let config = crate::session::local_config(port);
        let config = zenoh::Config::from_json5(&config).unwrap();
        let _session = zenoh::open(config).await.unwrap();
        let address = SocketAddr::from(([127, 0, 0, 1], port));
        TcpStream::connect(address).await.expect("it listens");
        assert_eq!(greet(address).await.unwrap(), Answer::Fine);
    }

    #[tokio::test]
    async fn a_program_that_closes_or_sends_nothing_is_silent_and_no_program_is_fine() {
        let begun = Instant::now();
        let [closes, keeps] = [listener(Some(b"")).await, listener(None).await];
        let (closes, keeps) = tokio::join!(answer(closes), answer(keeps));
        assert_eq!([closes, keeps], [Answer::Silence, Answer::Silence]);
        assert!(begun.elapsed() < TIMEOUT + Duration::from_secs(2), "{:?}", begun.elapsed());
        let unused = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
        assert_eq!(answer(unused).await, Answer::Fine);
    }

    #[tokio::test]
    async fn a_connection_to_itself_has_no_answer() {
        // If the local port is the destination port, the system connects a socket to itself.
        let socket = tokio::net::TcpSocket::new_v4().unwrap();
        socket.bind(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
        let address = socket.local_addr().unwrap();
        let mut stream = socket.connect(address).await.unwrap();
        assert_eq!(answer_on(&mut stream).await.unwrap(), Answer::Fine);
    }

    #[test]
    fn only_addresses_without_encryption_of_the_sessions_mode_are_probed() {
        let found = |mode, text| {
            let Contacts { asked, has_others } = Contacts::parse(mode, text);
            (asked.iter().map(|it| it.address.to_string()).collect::<Vec<_>>(), has_others)
        };
        let list = r#"["tcp/10.0.0.1:7448?prio=1-4#dscp=0xb8", "tcp/[::1]:7#a=b"]"#;
        let both = ["10.0.0.1:7448", "[::1]:7"].map(str::to_owned).to_vec();
        assert_eq!(found("\"peer\"", list), (both, false));
        for other in [r#"["tls/10.0.0.1:7449"]"#, r#"["tcp/drone.local:7448"]"#] {
            assert_eq!(found("null", other), (vec![], true), "{other}");
        }
        let modes = r#"{"peer": ["tcp/1.1.1.1:1", "tcp/1.1.1.1:1"], "client": ["tcp/2.2.2.2:2"]}"#;
        assert_eq!(found("\"client\"", modes).0, ["2.2.2.2:2"]);
        assert_eq!(found("null", modes).0, ["1.1.1.1:1"]);
        assert_eq!(found("\"router\"", modes), (vec![], false));
        assert_eq!((found("", ""), found("", "null")), ((vec![], false), (vec![], false)));
    }

    #[tokio::test]
    async fn a_tool_is_refused_only_where_all_its_addresses_are_foreign() {
        let foreign = listener(Some(b"HTTP/1.0 400 Bad Request\r\n\r\n")).await;
        let unused = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
        for (endpoints, is_refused) in [
            (vec![format!("tcp/{foreign}")], true),
            (vec![format!("tcp/{foreign}"), format!("tcp/{foreign}?prio=5-6")], true),
            (vec![format!("tcp/{foreign}"), format!("tcp/{unused}")], false),
            (vec![format!("tcp/{foreign}"), "tcp/drone.local:7448".to_owned()], false),
            (vec![], false),
        ] {
            let mut config = zenoh::Config::default();
            let text = serde_json::to_string(&endpoints).unwrap();
            config.insert_json5("connect/endpoints", &text).unwrap();
            assert_eq!(refuse(&config).await.is_err(), is_refused, "{text}");
        }
    }

    #[test]
    fn an_error_names_the_port_and_a_remedy() {
        let problem_of = |endpoint: &str, answer| Contact::of(endpoint).unwrap().problem(&answer);
        let here = problem_of("tcp/127.0.0.1:7447", Answer::Foreign("`HTTP`".to_owned())).unwrap();
        for part in ["port 7447 of this machine", "answers `HTTP`", "ss -ltnp", "--meet PORT"] {
            assert!(here.contains(part), "`{part}` is not in: {here}");
        }
        // A tunnel has its end here as well.
        for endpoint in ["tcp/10.0.0.1:7448", "tcp/127.0.0.1:7448?prio=5-6"] {
            let there = problem_of(endpoint, Answer::Silence).unwrap();
            for part in ["0.0.1:7448, to which", "2 s", "on that machine", "--connect"] {
                assert!(there.contains(part), "`{part}` is not in: {there}");
            }
            let keys = problem_of(endpoint, Answer::Encrypted).unwrap();
            assert!(keys.contains("wants keys") && keys.contains("`--keys DIRECTORY`"), "{keys}");
            assert!(!keys.contains("end it"), "a relay is to be ended: {keys}");
        }
        let speaks_tls = problem_of("tcp/127.0.0.1:7447", Answer::Encrypted).unwrap();
        assert!(speaks_tls.contains("TLS") && !speaks_tls.contains("end it"), "{speaks_tls}");
        assert_eq!(problem_of("tcp/127.0.0.1:7447", Answer::Fine), None);
    }
}
