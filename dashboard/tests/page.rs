//! Tests the dashboard's HTTP server and WebSockets with a simulated controller and camera: refused requests, state with
//! ages, held commands, pictures with detections, tokens, encryption.

use std::fs::Permissions;
use std::net::{IpAddr, SocketAddr, UdpSocket};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use dashboard::Config;
use dashboard::tokens::{Kind, Tokens, secret};
use futures_util::{SinkExt, StreamExt};
use messages::{
    CommandReply, ControllerCommand, ControllerStatus, Detections, FrameHeader, Phase, PixelFormat,
    Refusals, topic,
};
use node::{Identity, Layers, Node, Shutdown, ZenohSource};
use rustls::crypto::ring;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, ServerName};
use rustls::{ClientConfig, RootCertStore};
use serde_json::{Value, json};
use testing::{ports, until};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::http::{HeaderValue, Request};
use tokio_tungstenite::tungstenite::{Error, Message};
use tokio_tungstenite::{WebSocketStream, client_async};

const TIMEOUT: Duration = Duration::from_secs(20);
/// Longer than the time for which a button is held.
const HELD: Duration = Duration::from_millis(1050);

type Socket = WebSocketStream<TcpStream>;

/// The transport of a WebSocket.
trait Stream: AsyncRead + AsyncWrite + Unpin {}
impl<S: AsyncRead + AsyncWrite + Unpin> Stream for S {}

/// A dashboard with its network.
struct Page {
    meet: u16,
    address: SocketAddr,
    node: Node,
    task: JoinHandle<anyhow::Result<()>>,
}

impl Page {
    async fn start(set: &[&str]) -> anyhow::Result<Self> {
        Self::start_at("127.0.0.1", set).await
    }

    async fn start_at(host: &str, set: &[&str]) -> anyhow::Result<Self> {
        let ([meet, port], _, _) = ports::free()?;
        let listen = format!("listen={host}:{port}");
        let set = [listen.as_str()].iter().chain(set).map(|text| (*text).to_owned()).collect();
        let config = Layers { file: None, set }.load::<Config>()?.settings;
        let node = open("dashboard", meet).await?;
        let shutdown = Shutdown::on_signals()?;
        let task = tokio::spawn(dashboard::run(node.clone(), config, shutdown));
        let address = SocketAddr::new("127.0.0.1".parse()?, port);
        until("the page listens", TIMEOUT, async || TcpStream::connect(address).await.is_ok())
            .await?;
        Ok(Self { meet, address, node, task })
    }

    /// The number of requests refused for this reason.
    fn refused(&self, reason: &str) -> u64 {
        let drops = self.node.health().report(self.node.identity(), 0).drops;
        drops.iter().find(|it| it.reason == reason).map_or(0, |it| it.count)
    }

    async fn socket(&self, path: &str) -> anyhow::Result<Socket> {
        let request = self.request(self.address, path)?;
        Ok(connected(self.address, request).await?)
    }

    fn request(&self, address: SocketAddr, path: &str) -> anyhow::Result<Request<()>> {
        let mut request = format!("ws://{address}{path}").into_client_request()?;
        let origin = HeaderValue::from_str(&format!("http://{address}"))?;
        request.headers_mut().insert("origin", origin);
        Ok(request)
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn open(service: &'static str, meet: u16) -> anyhow::Result<Node> {
    let source = ZenohSource::Text(node::session::local_config(meet));
    Node::open(Identity { service, instance: "main".into() }, &source).await
}

async fn connected(address: SocketAddr, request: Request<()>) -> Result<Socket, Error> {
    let stream = TcpStream::connect(address).await.map_err(Error::Io)?;
    Ok(client_async(request, stream).await?.0)
}

/// The status code of a refused WebSocket.
async fn refusal(address: SocketAddr, request: Request<()>) -> anyhow::Result<u16> {
    match connected(address, request).await {
        Err(Error::Http(response)) => Ok(response.status().as_u16()),
        Err(error) => Err(error.into()),
        Ok(_) => bail!("it was not refused"),
    }
}

/// An answer to a plain request: status line, headers, body.
async fn ask(address: SocketAddr, request: &str) -> anyhow::Result<String> {
    let mut stream = TcpStream::connect(address).await?;
    stream.write_all(request.as_bytes()).await?;
    let mut answer = Vec::new();
    timeout(TIMEOUT, stream.read_to_end(&mut answer)).await??;
    Ok(String::from_utf8_lossy(&answer).into_owned())
}

fn get(path: &str, host: &str, more: &str) -> String {
    format!("GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n{more}\r\n")
}

async fn next(socket: &mut WebSocketStream<impl Stream>) -> anyhow::Result<Message> {
    Ok(timeout(TIMEOUT, socket.next()).await?.context("the connection was closed")??)
}

/// The next message that meets a condition.
async fn receive(
    socket: &mut WebSocketStream<impl Stream>,
    is_expected: impl Fn(&Value) -> bool,
) -> anyhow::Result<Value> {
    let found = timeout(TIMEOUT, async {
        loop {
            if let Message::Text(text) = next(socket).await? {
                let value: Value = serde_json::from_str(&text)?;
                if is_expected(&value) {
                    return anyhow::Ok(value);
                }
            }
        }
    });
    found.await.context("waiting for a message")?
}

async fn send(socket: &mut WebSocketStream<impl Stream>, value: Value) -> anyhow::Result<()> {
    Ok(socket.send(Message::text(value.to_string())).await?)
}

fn status() -> ControllerStatus {
    ControllerStatus {
        phase: Phase::Descend,
        why: "descending over the marker".into(),
        active_detector: Some("main".into()),
        height_m: Some(4.2),
        ..ControllerStatus::default()
    }
}

/// A controller that publishes its status, and accepts every command except resume.
fn controller(node: Node) -> JoinHandle<anyhow::Result<()>> {
    tokio::spawn(async move {
        let statuses = node.publisher(topic::STATUS, &[]).await?;
        let commands = node.commands(topic::COMMAND, &[]).await?;
        let mut due = tokio::time::interval(Duration::from_millis(50));
        loop {
            tokio::select! {
                _ = due.tick() => statuses.publish(&status()).await,
                request = commands.next() => {
                    let request = request.context("closed")?;
                    let accepted = request.message != ControllerCommand::Resume;
                    let reason = format!("{:?} was received", request.message);
                    request.answer(&CommandReply { accepted, reason }).await;
                }
            }
        }
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn foreign_requests_are_refused_and_counted() -> anyhow::Result<()> {
    let page = Page::start(&["max_clients=2"]).await?;
    let address = page.address.to_string();
    let answer = ask(page.address, &get("/", &address, "")).await?.to_lowercase();
    ensure!(
        answer.starts_with("http/1.1 200") && answer.contains("<title>alight</title>"),
        "{answer}"
    );
    ensure!(
        answer.contains("content-security-policy: default-src 'none'; script-src 'self'"),
        "{answer}"
    );
    ensure!(!answer.contains("unsafe-inline") && answer.contains("nosniff"), "{answer}");

    for path in ["/", "/session", "/app.js", "/nothing"] {
        let answer = ask(page.address, &get(path, "rebound.example", "")).await?;
        ensure!(answer.starts_with("HTTP/1.1 421") && answer.contains("not served"), "{answer}");
    }
    ensure!(page.refused("wrong Host") == 4, "{}", page.refused("wrong Host"));
    let foreign = "Origin: http://evil.example\r\n";
    let answer = ask(page.address, &get("/session", &address, foreign)).await?;
    ensure!(answer.starts_with("HTTP/1.1 403"), "{answer}");

    for path in ["/ws", "/video"] {
        let mut request = page.request(page.address, path)?;
        request.headers_mut().insert("origin", HeaderValue::from_static("http://evil.example"));
        ensure!(refusal(page.address, request).await? == 403, "{path}");
        let mut request = page.request(page.address, path)?;
        request.headers_mut().insert("host", HeaderValue::from_static("rebound.example"));
        ensure!(refusal(page.address, request).await? == 421, "{path}");
    }
    ensure!(page.refused("wrong Origin") == 3, "{}", page.refused("wrong Origin"));

    let _two = [page.socket("/ws").await?, page.socket("/ws").await?];
    let third = refusal(page.address, page.request(page.address, "/ws")?).await?;
    ensure!(third == 503 && page.refused("too many browsers") == 1, "{third}");
    let answer = ask(page.address, &get("/session", &address, "")).await?;
    ensure!(answer.starts_with("HTTP/1.1 503") && answer.contains("`max_clients`"), "{answer}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_state_is_sent_with_its_age() -> anyhow::Result<()> {
    let page = Page::start(&[]).await?;
    let controller = controller(open("controller", page.meet).await?);
    let mut socket = page.socket("/ws").await?;
    let hello = receive(&mut socket, |it| it["kind"] == "hello").await?;
    ensure!(hello["no_commands"].as_str().is_some_and(|why| why.contains("only shows")), "{hello}");
    ensure!(hello["vehicle"] == "drone", "{hello}");
    let is_young = |it: &Value| it["status"]["age_ms"].as_f64().is_some_and(|age| age < 700.0);
    let is_current = |it: &Value| it["status"]["phase"] == "descend" && is_young(it);
    let now = receive(&mut socket, is_current).await?;
    ensure!(now["status"]["title"] == "Descending" && now["status"]["height_m"] == 4.2, "{now}");
    let is_entry = |it: &Value| it["text"] == "descend: descending over the marker";
    let has_entry =
        |it: &Value| it["entries"].as_array().is_some_and(|list| list.iter().any(is_entry));
    // The log is sent when it changes, which may have been before: a new page gets the complete log.
    receive(&mut page.socket("/ws").await?, has_entry).await?;
    let slow = receive(&mut socket, |it| it["kind"] == "slow").await?;
    ensure!(slow["checks"].as_array().is_some_and(|list| list.len() > 10), "{slow}");
    controller.abort();
    receive(&mut socket, |it| it["status"]["age_ms"].as_f64().is_some_and(|age| age > 1500.0))
        .await?;
    Ok(())
}

/// The page subtracts the age of an entry from the time of arrival.
#[tokio::test(flavor = "multi_thread")]
async fn the_log_of_a_page_opened_later_has_the_time_at_which_it_is_sent() -> anyhow::Result<()> {
    let page = Page::start(&[]).await?;
    let _controller = controller(open("controller", page.meet).await?);
    let has_entry =
        |it: &Value| it["entries"].as_array().is_some_and(|entries| !entries.is_empty());
    receive(&mut page.socket("/ws").await?, has_entry).await?;
    sleep(Duration::from_millis(1500)).await;
    let mut socket = page.socket("/ws").await?;
    let log = receive(&mut socket, has_entry).await?;
    let now = receive(&mut socket, |it| it["kind"] == "now").await?;
    let times_ms = [&log, &now].map(|it| it["now_ms"].as_f64());
    let [Some(log_ms), Some(now_ms)] = times_ms else { bail!("{log} {now}") };
    ensure!(now_ms - log_ms < 1000.0, "the log is {} ms old", now_ms - log_ms);
    Ok(())
}

async fn nonce(socket: &mut WebSocketStream<impl Stream>, command: &str) -> anyhow::Result<String> {
    send(socket, json!({ "kind": "nonce", "command": command })).await?;
    let answer = receive(socket, |it| it["kind"] == "nonce").await?;
    Ok(answer["nonce"].as_str().context("a nonce")?.to_owned())
}

async fn command(
    socket: &mut WebSocketStream<impl Stream>,
    command: &str,
    nonce: &str,
) -> anyhow::Result<Value> {
    send(socket, json!({ "kind": "command", "command": command, "nonce": nonce })).await?;
    receive(socket, |it| it["kind"] == "reply").await
}

/// The command was not refused, and may have been carried out.
#[tokio::test(flavor = "multi_thread")]
async fn a_command_without_an_answer_is_reported_as_such() -> anyhow::Result<()> {
    let page = Page::start(&["commands=here"]).await?;
    let mut socket = page.socket("/ws").await?;
    let nonce = nonce(&mut socket, "hold").await?;
    sleep(HELD).await;
    let reply = command(&mut socket, "hold", &nonce).await?;
    ensure!(reply["accepted"] == false && reply["who"] == "nobody", "{reply}");
    ensure!(reply["why"].as_str().is_some_and(|why| why.contains("no controller")), "{reply}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_command_is_held_for_a_second_and_given_once() -> anyhow::Result<()> {
    let page = Page::start(&["commands=here"]).await?;
    let _controller = controller(open("controller", page.meet).await?);
    let mut socket = page.socket("/ws").await?;
    receive(&mut socket, |it| it["status"]["phase"] == "descend").await?;

    let without = command(&mut socket, "abort", "").await?;
    ensure!(without["accepted"] == false && without["who"] == "dashboard", "{without}");
    let first = nonce(&mut socket, "hold").await?;
    let early = command(&mut socket, "hold", &first).await?;
    ensure!(early["why"].as_str().is_some_and(|why| why.contains("not held for 1 s")), "{early}");
    let second = nonce(&mut socket, "hold").await?;
    sleep(HELD).await;
    let held = command(&mut socket, "hold", &second).await?;
    ensure!(held["accepted"] == true && held["who"] == "controller", "{held}");
    ensure!(held["why"] == "Hold was received", "{held}");
    let third = nonce(&mut socket, "land-here").await?;
    sleep(HELD).await;
    let landing = command(&mut socket, "land-here", &third).await?;
    ensure!(landing["why"] == "LandHere was received", "{landing}");
    let again = command(&mut socket, "hold", &second).await?;
    ensure!(again["accepted"] == false && again["who"] == "dashboard", "{again}");
    // The nonce of another browser is not valid.
    let mut other = page.socket("/ws").await?;
    let foreign = nonce(&mut other, "abort").await?;
    let third = nonce(&mut socket, "resume").await?;
    sleep(HELD).await;
    let swapped = command(&mut socket, "abort", &foreign).await?;
    ensure!(swapped["accepted"] == false && swapped["who"] == "dashboard", "{swapped}");
    let spent = command(&mut socket, "resume", &third).await?;
    ensure!(spent["accepted"] == false, "{spent}");
    let fourth = nonce(&mut socket, "resume").await?;
    sleep(HELD).await;
    let refused = command(&mut socket, "resume", &fourth).await?;
    ensure!(refused["accepted"] == false && refused["who"] == "controller", "{refused}");
    let late = nonce(&mut socket, "abort").await?;
    sleep(Duration::from_millis(3100)).await;
    let late = command(&mut socket, "abort", &late).await?;
    ensure!(late["why"].as_str().is_some_and(|why| why.contains("more than 3 s")), "{late}");
    for (reason, count) in [
        ("command without a valid nonce", 4),
        ("command not held for a second", 1),
        ("late command", 1),
    ] {
        ensure!(page.refused(reason) == count, "{reason}: {}", page.refused(reason));
    }
    Ok(())
}

/// A camera and a detector: frames at 20 Hz, each with its detections 30 ms later.
fn camera(node: Node) -> JoinHandle<anyhow::Result<()>> {
    tokio::spawn(async move {
        let frames = node.frame_publisher(topic::FRAME, &["down"], 64 * 48).await?;
        let detections = node.publisher(topic::DETECTIONS, &["main"]).await?;
        for number in 0.. {
            let header = FrameHeader {
                sequence: number,
                stamp_ns: number as i64 * 50_000_000,
                width: 64,
                height: 48,
                format: PixelFormat::Mono8,
                ..FrameHeader::sample()
            };
            let mut loan = frames.loan(64 * 48);
            loan.fill(100);
            frames.publish(&header, loan).await;
            sleep(Duration::from_millis(30)).await;
            detections.publish(&Detections { header, ..Detections::sample() }).await;
            sleep(Duration::from_millis(20)).await;
        }
        Ok(())
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn refused_candidates_are_sent_while_they_are_requested() -> anyhow::Result<()> {
    let page = Page::start(&["video.max_hz=30"]).await?;
    let node = open("detector", page.meet).await?;
    let refusals = node.publisher(topic::REFUSALS, &["main"]).await?;
    let detections = node.subscriber(topic::DETECTIONS, &[]).await?;
    let _camera = camera(node);
    let _refuses = tokio::spawn(async move {
        while let Some(Detections { header, .. }) = detections.next().await {
            // As a detector does: for subscribers only, after the detections.
            if refusals.has_subscribers().await {
                let refused = Refusals { header, total: 7, ..Refusals::sample() };
                refusals.publish(&refused).await;
            }
        }
    });
    let mut socket = page.socket("/video").await?;
    let until = async |socket: &mut Socket, is_expected: bool| {
        let found = timeout(TIMEOUT, async {
            loop {
                let Some((header, _)) = picture(socket).await? else { continue };
                let number = header["number"].to_string();
                socket.send(Message::text(number)).await?;
                if header["refused"].is_null() != is_expected {
                    return anyhow::Ok(header);
                }
            }
        });
        found.await.with_context(|| format!("refused candidates are sent: {is_expected}"))?
    };
    until(&mut socket, false).await?;
    socket.send(Message::text("refused")).await?;
    for _ in 0..5 {
        let header = until(&mut socket, true).await?;
        ensure!(
            header["refused"][0]["reason"] == "code" && header["refused_total"] == 7,
            "{header}"
        );
        ensure!(header["found_sequence"] == header["sequence"], "{header}");
    }
    socket.send(Message::text("nothing refused")).await?;
    until(&mut socket, false).await?;
    ensure!(page.refused("wrong acknowledgement") == 0);
    Ok(())
}

/// The header and the file of a picture.
async fn picture(socket: &mut Socket) -> anyhow::Result<Option<(Value, Vec<u8>)>> {
    let Ok(message) = timeout(Duration::from_millis(1500), socket.next()).await else {
        return Ok(None);
    };
    let Some(Ok(Message::Binary(bytes))) = message else { bail!("not a picture: {message:?}") };
    let length = u32::from_le_bytes(bytes.get(..4).context("a length")?.try_into()?) as usize;
    let header = serde_json::from_slice(bytes.get(4..4 + length).context("a header")?)?;
    Ok(Some((header, bytes[4 + length..].to_vec())))
}

#[tokio::test(flavor = "multi_thread")]
async fn at_most_two_pictures_are_in_transit_each_with_its_own_detections() -> anyhow::Result<()> {
    let page = Page::start(&["video.max_hz=30"]).await?;
    let _camera = camera(open("detector", page.meet).await?);
    let mut socket = page.socket("/video").await?;
    let mut shown = Vec::new();
    let first = timeout(TIMEOUT, async {
        loop {
            if let Some(first) = picture(&mut socket).await? {
                return anyhow::Ok(first);
            }
        }
    });
    shown.push(first.await??);
    while let Some(further) = picture(&mut socket).await? {
        shown.push(further);
    }
    ensure!(shown.len() == 2, "{} pictures without an acknowledgement", shown.len());
    // A wrong acknowledgement makes no room.
    socket.send(Message::text("999999")).await?;
    ensure!(picture(&mut socket).await?.is_none() && page.refused("wrong acknowledgement") == 1);
    for _ in 0..20 {
        let number = shown.last().context("a picture")?.0["number"].to_string();
        socket.send(Message::text(number)).await?;
        shown.push(picture(&mut socket).await?.context("the next picture")?);
    }
    let mut bare = 0;
    for (header, file) in &shown {
        ensure!(file.starts_with(&[0xff, 0xd8]), "{header}");
        bare += usize::from(header["found_sequence"].is_null());
        let is_own = header["found_sequence"] == header["sequence"];
        ensure!(is_own || header["found_sequence"].is_null(), "{header}");
    }
    ensure!(bare <= 3, "{bare} of {} pictures had no detections", shown.len());
    let sequence = |at: usize| shown[at].0["sequence"].as_u64().context("a number");
    // Pictures in between were left out: the third is much newer than the second.
    ensure!(sequence(2)? > sequence(1)? + 20, "{} after {}", sequence(2)?, sequence(1)?);
    Ok(())
}

/// An address of this machine other than loopback.
fn outward() -> Option<IpAddr> {
    let socket = UdpSocket::bind("0.0.0.0:0").ok()?;
    // Nothing is sent.
    socket.connect("192.0.2.1:9").ok()?;
    let address = socket.local_addr().ok()?.ip();
    (!address.is_loopback() && !address.is_unspecified()).then_some(address)
}

/// A certificate for a page, in files.
fn certificate(folder: &Path, names: &[String]) -> anyhow::Result<[PathBuf; 2]> {
    let files = [folder.join("page.pem"), folder.join("page.key")];
    let made = rcgen::generate_simple_self_signed(names)?;
    std::fs::write(&files[0], made.cert.pem())?;
    std::fs::write(&files[1], made.signing_key.serialize_pem())?;
    std::fs::set_permissions(&files[1], Permissions::from_mode(0o600))?;
    Ok(files)
}

/// A client that trusts this certificate alone.
fn trusting(certificate: &Path) -> anyhow::Result<TlsConnector> {
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_file(certificate)?)?;
    let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()?
        .with_root_certificates(roots)
        .with_no_client_auth();
    Ok(TlsConnector::from(Arc::new(config)))
}

async fn encrypted(
    connector: &TlsConnector,
    address: SocketAddr,
) -> anyhow::Result<TlsStream<TcpStream>> {
    let stream = TcpStream::connect(address).await?;
    Ok(connector.connect(ServerName::from(address.ip()), stream).await?)
}

#[tokio::test(flavor = "multi_thread")]
async fn an_encrypted_page_takes_commands_from_other_machines_while_its_token_exists()
-> anyhow::Result<()> {
    let Some(outward) = outward() else {
        testing::skip("network", "this machine has no address but loopback");
        return Ok(());
    };
    let folder = tempfile::tempdir()?;
    let [pem, key] = certificate(folder.path(), &[outward.to_string()])?;
    let file = folder.path().join("tokens");
    let token = secret()?;
    let mut tokens = Tokens::default();
    tokens.add(&token, Kind::Command, 0, u64::MAX);
    tokens.write(&file)?;
    let set = [("tokens", &file), ("certificate", &pem), ("key", &key)]
        .map(|(k, p)| format!("{k}={p:?}"));
    let set = [&["commands=token"], &set.each_ref().map(String::as_str)[..]].concat();
    let page = Page::start_at("0.0.0.0", &set).await?;
    let controller = controller(open("controller", page.meet).await?);
    let from = SocketAddr::new(outward, page.address.port());

    // Without encryption there is only a redirection to the page.
    let moved = ask(from, &get("/", &from.to_string(), "")).await?;
    ensure!(moved.starts_with("HTTP/1.1 307"), "{moved}");
    ensure!(moved.contains(&format!("location: https://{from}/")), "{moved}");
    ensure!(ask(from, &get("/", "evil.example", "")).await?.starts_with("HTTP/1.1 421"));
    let log_in = format!(
        "POST /login HTTP/1.1\r\nHost: {from}\r\nOrigin: https://{from}\r\nConnection: close\r\nContent-Length: {}\r\n\r\n{token}",
        token.len()
    );
    ensure!(ask(from, &log_in).await?.starts_with("HTTP/1.1 426"));
    ensure!(refusal(from, page.request(from, "/ws")?).await? == 426);
    ensure!(page.refused("request without TLS") == 2);

    // A client that does not trust the certificate sends nothing.
    let others = tempfile::tempdir()?;
    let [other, _] = certificate(others.path(), &[outward.to_string()])?;
    ensure!(encrypted(&trusting(&other)?, from).await.is_err());
    let is_counted = async || page.refused("no encrypted connection") == 1;
    until("an aborted handshake is counted", TIMEOUT, is_counted).await?;
    let connector = trusting(&pem)?;
    let mut stream = encrypted(&connector, from).await?;
    stream.write_all(log_in.as_bytes()).await?;
    let mut answer = Vec::new();
    timeout(TIMEOUT, stream.read_to_end(&mut answer)).await??;
    let answer = String::from_utf8_lossy(&answer).into_owned();
    let cookie = answer.lines().find_map(|line| line.strip_prefix("set-cookie: "));
    let cookie = cookie.with_context(|| answer.clone())?;
    ensure!(cookie.contains("; Secure"), "{cookie}");
    let cookie = HeaderValue::from_str(cookie.split(';').next().context("a cookie")?)?;

    let request = |scheme: &str| -> anyhow::Result<Request<()>> {
        let mut request = page.request(from, "/ws")?;
        let origin = HeaderValue::from_str(&format!("{scheme}://{from}"))?;
        request.headers_mut().insert("origin", origin);
        request.headers_mut().insert("cookie", cookie.clone());
        Ok(request)
    };
    let wrong = client_async(request("http")?, encrypted(&connector, from).await?).await;
    ensure!(matches!(wrong, Err(Error::Http(response)) if response.status() == 403));
    let (mut socket, _) =
        client_async(request("https")?, encrypted(&connector, from).await?).await?;
    let hello = receive(&mut socket, |it| it["kind"] == "hello").await?;
    ensure!(hello["no_commands"].is_null(), "{hello}");
    let held = nonce(&mut socket, "hold").await?;
    sleep(HELD).await;
    let reply = command(&mut socket, "hold", &held).await?;
    ensure!(reply["accepted"] == true && reply["who"] == "controller", "{reply}");

    // A file that cannot be read for a moment ends no session, and admits no client.
    let away = folder.path().join("away");
    std::fs::rename(&file, &away)?;
    std::fs::create_dir(&file)?;
    sleep(Duration::from_secs(3)).await;
    let held = nonce(&mut socket, "hold").await?;
    sleep(HELD).await;
    let reply = command(&mut socket, "hold", &held).await?;
    ensure!(reply["accepted"] == true, "{reply}");
    let mut stream = encrypted(&connector, from).await?;
    stream.write_all(log_in.as_bytes()).await?;
    let mut answer = Vec::new();
    timeout(TIMEOUT, stream.read_to_end(&mut answer)).await??;
    ensure!(answer.starts_with(b"HTTP/1.1 401"), "{}", String::from_utf8_lossy(&answer));
    std::fs::remove_dir(&file)?;
    std::fs::rename(&away, &file)?;

    // The page is closed once its token is removed, also where the editor left the file readable by others.
    Tokens::default().write(&file)?;
    std::fs::set_permissions(&file, Permissions::from_mode(0o644))?;
    let closed = timeout(TIMEOUT, async { while let Some(Ok(_)) = socket.next().await {} });
    closed.await.context("the page is still open without its token")?;
    let again = client_async(request("https")?, encrypted(&connector, from).await?).await;
    ensure!(matches!(again, Err(Error::Http(response)) if response.status() == 401));
    controller.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn other_machines_need_a_token_and_cannot_command_without_encryption() -> anyhow::Result<()> {
    let Some(outward) = outward() else {
        testing::skip("network", "this machine has no address but loopback");
        return Ok(());
    };
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("tokens");
    let [good, old, look] = [secret()?, secret()?, secret()?];
    let mut tokens = Tokens::default();
    tokens.add(&old, Kind::Command, 0, 1);
    tokens.add(&look, Kind::Monitor, 0, u64::MAX);
    tokens.add(&good, Kind::Command, 0, u64::MAX);
    tokens.write(&file)?;
    let named = format!("tokens={:?}", file.display().to_string());
    let page = Page::start_at("0.0.0.0", &["commands=here", &named]).await?;
    let from = SocketAddr::new(outward, page.address.port());

    // The files of the page contain no data.
    ensure!(ask(from, &get("/", &from.to_string(), "")).await?.starts_with("HTTP/1.1 200"));
    for path in ["/ws", "/video"] {
        ensure!(refusal(from, page.request(from, path)?).await? == 401, "{path}");
    }
    let log_in = |token: &str| {
        let length = token.len();
        format!(
            "POST /login HTTP/1.1\r\nHost: {from}\r\nOrigin: http://{from}\r\nConnection: close\r\nContent-Length: {length}\r\n\r\n{token}"
        )
    };
    for wrong in ["", "wrong", old.as_str()] {
        let answer = ask(from, &log_in(wrong)).await?;
        ensure!(answer.starts_with("HTTP/1.1 401"), "{answer}");
    }
    ensure!(page.refused("no valid token") == 5, "{}", page.refused("no valid token"));
    let answer = ask(from, &log_in(&good)).await?;
    let cookie = answer.lines().find_map(|line| line.strip_prefix("set-cookie: "));
    let cookie = cookie.with_context(|| answer.clone())?;
    ensure!(cookie.contains("HttpOnly") && cookie.contains("SameSite=Strict"), "{cookie}");
    let cookie = cookie.split(';').next().context("a cookie")?;
    let mut foreign = page.request(from, "/ws")?;
    foreign.headers_mut().insert("cookie", HeaderValue::from_static("alight-80=1; other=2"));
    ensure!(refusal(from, foreign).await? == 401);
    // A cookie with the page's name but no session is refused as well.
    let mut made_up = page.request(from, "/ws")?;
    let cookie_of_none = format!("alight-{}={}", from.port(), secret()?);
    made_up.headers_mut().insert("cookie", HeaderValue::from_str(&cookie_of_none)?);
    ensure!(refusal(from, made_up).await? == 401);
    ensure!(page.refused("no valid token") == 7, "{}", page.refused("no valid token"));

    // Log-ins with another token end no session of this one.
    for _ in 0..70 {
        ensure!(ask(from, &log_in(&look)).await?.starts_with("HTTP/1.1 200"));
    }

    let mut request = page.request(from, "/ws")?;
    request.headers_mut().insert("cookie", HeaderValue::from_str(cookie)?);
    let mut socket = connected(from, request).await?;
    let hello = receive(&mut socket, |it| it["kind"] == "hello").await?;
    ensure!(
        hello["no_commands"].as_str().is_some_and(|why| why.contains("not encrypted")),
        "{hello}"
    );
    let held = nonce(&mut socket, "abort").await?;
    sleep(HELD).await;
    let refused = command(&mut socket, "abort", &held).await?;
    ensure!(refused["accepted"] == false && refused["who"] == "dashboard", "{refused}");
    ensure!(page.refused("command without the right") == 1);

    // An ended session is not valid any more.
    let log_out = format!(
        "POST /logout HTTP/1.1\r\nHost: {from}\r\nOrigin: http://{from}\r\nCookie: {cookie}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
    );
    ensure!(ask(from, &log_out).await?.starts_with("HTTP/1.1 200"));
    let mut ended = page.request(from, "/ws")?;
    ended.headers_mut().insert("cookie", HeaderValue::from_str(cookie)?);
    ensure!(refusal(from, ended).await? == 401);
    Ok(())
}
