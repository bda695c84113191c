//! The recorder's WebSocket for viewers, with clients of the Foxglove protocol and a camera made up here: channels, refused
//! pages, a slow client, an address that is taken.

#![expect(clippy::print_stdout, reason = "measurements are for people to read")]

use std::net::SocketAddr;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, bail, ensure};
use flightlog::live::SUBPROTOCOLS;
use futures_util::{SinkExt, StreamExt};
use messages::{FrameHeader, PixelFormat, Wind, topic};
use node::{Identity, Layers, Node, Shutdown, ZenohSource, now_ns};
use recorder::Config;
use serde_json::{Value, json};
use testing::{ports, until, with_second_try};
use tokio::net::{TcpSocket, TcpStream};
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::http::{HeaderValue, Request};
use tokio_tungstenite::tungstenite::{Error, Message};
use tokio_tungstenite::{WebSocketStream, client_async};

const TIMEOUT: Duration = Duration::from_secs(20);
/// The size of the camera's frames: pictures of 90 kB.
const WIDTH: u32 = 300;
const HEIGHT: u32 = 300;

/// A recorder that serves, with its network.
struct Served {
    meet: u16,
    address: SocketAddr,
    node: Node,
    task: JoinHandle<anyhow::Result<()>>,
}

impl Served {
    async fn start(set: &[&str]) -> anyhow::Result<Self> {
        let ([meet, port], _, _) = ports::free()?;
        let serve = format!("serve=127.0.0.1:{port}");
        let all = [&[serve.as_str(), "frames=raw"], set].concat();
        let set = all.into_iter().map(str::to_owned).collect();
        let config = Layers { file: None, set }.load::<Config>()?.settings;
        let node = open("recorder", meet).await?;
        let task = tokio::spawn(recorder::run(node.clone(), config, Shutdown::on_signals()?));
        let address = SocketAddr::new("127.0.0.1".parse()?, port);
        until("the recorder listens", TIMEOUT, async || TcpStream::connect(address).await.is_ok())
            .await?;
        Ok(Self { meet, address, node, task })
    }

    fn request(&self, subprotocol: &str) -> anyhow::Result<Request<()>> {
        let mut request = format!("ws://{}/", self.address).into_client_request()?;
        let value = HeaderValue::from_str(subprotocol)?;
        request.headers_mut().insert("sec-websocket-protocol", value);
        Ok(request)
    }

    /// A client whose system takes little in advance, as on a slow link.
    async fn connected(&self, request: Request<()>) -> Result<Client, Error> {
        let socket = TcpSocket::new_v4().map_err(Error::Io)?;
        socket.set_recv_buffer_size(20_000).map_err(Error::Io)?;
        let stream = socket.connect(self.address).await.map_err(Error::Io)?;
        Ok(Client { socket: client_async(request, stream).await?.0 })
    }

    /// A client that has received the server's name.
    async fn client(&self) -> anyhow::Result<Client> {
        let mut client = self.connected(self.request(SUBPROTOCOLS[0])?).await?;
        let info = client.text("serverInfo").await?;
        ensure!(info["capabilities"] == json!([]) && info["sessionId"].is_string(), "{info}");
        Ok(client)
    }

    /// The status with which a client is refused.
    async fn refusal(&self, request: Request<()>) -> anyhow::Result<u16> {
        match self.connected(request).await {
            Err(Error::Http(response)) => Ok(response.status().as_u16()),
            Err(error) => Err(error.into()),
            Ok(_) => bail!("it was not refused"),
        }
    }

    fn dropped(&self, reason: &str) -> u64 {
        let drops = self.node.health().report(self.node.identity(), 0).drops;
        drops.iter().find(|it| it.reason == reason).map_or(0, |it| it.count)
    }

    /// Publishes a wind every 20 ms, which counts.
    fn blow(&self) -> JoinHandle<anyhow::Result<()>> {
        let meet = self.meet;
        tokio::spawn(async move {
            let node = open("simulator", meet).await?;
            let winds = node.publisher(topic::WIND, &[]).await?;
            for number in 0..u32::MAX {
                let velocity_ned_m_s = [f64::from(number), 0.0, 0.0];
                winds.publish(&Wind { velocity_ned_m_s, stamp_ns: now_ns() }).await;
                sleep(Duration::from_millis(20)).await;
            }
            Ok(())
        })
    }

    /// Publishes frames at 30 Hz.
    fn film(&self) -> JoinHandle<anyhow::Result<()>> {
        let meet = self.meet;
        tokio::spawn(async move {
            let node = open("camera-pub", meet).await?;
            let bytes = (WIDTH * HEIGHT) as usize;
            let frames = node.frame_publisher(topic::FRAME, &["down"], bytes).await?;
            for sequence in 0..u64::MAX {
                let header = FrameHeader {
                    sequence,
                    stamp_ns: now_ns(),
                    width: WIDTH,
                    height: HEIGHT,
                    format: PixelFormat::Mono8,
                    ..FrameHeader::sample()
                };
                frames.publish(&header, frames.loan(bytes)).await;
                sleep(Duration::from_millis(33)).await;
            }
            Ok(())
        })
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn open(service: &'static str, meet: u16) -> anyhow::Result<Node> {
    let source = ZenohSource::Text(node::session::local_config(meet));
    Node::open(Identity { service, instance: "main".into() }, &source).await
}

/// One that follows.
struct Client {
    socket: WebSocketStream<TcpStream>,
}

impl Client {
    async fn next(&mut self) -> anyhow::Result<Message> {
        Ok(timeout(TIMEOUT, self.socket.next()).await?.context("the connection was closed")??)
    }

    /// The next text with this `op`.
    async fn text(&mut self, op: &str) -> anyhow::Result<Value> {
        loop {
            if let Message::Text(text) = self.next().await? {
                let value: Value = serde_json::from_str(&text)?;
                if value["op"] == op {
                    return Ok(value);
                }
            }
        }
    }

    async fn ask(&mut self, request: &Value) -> anyhow::Result<()> {
        Ok(self.socket.send(Message::text(request.to_string())).await?)
    }

    /// Subscribes to a channel under this number, once there is one; returns its announcement.
    async fn subscribe(&mut self, topic: &str, id: u32) -> anyhow::Result<Value> {
        loop {
            let announced = self.text("advertise").await?;
            let channels = announced["channels"].as_array().context("channels")?;
            if let Some(channel) = channels.iter().find(|it| it["topic"] == topic) {
                let requested = json!([{ "id": id, "channelId": channel["id"] }]);
                self.ask(&json!({ "op": "subscribe", "subscriptions": requested })).await?;
                return Ok(channel.clone());
            }
        }
    }

    /// The next message.
    async fn message(&mut self) -> anyhow::Result<Followed> {
        loop {
            if let Message::Binary(bytes) = self.next().await? {
                let (head, data) = bytes.split_at_checked(13).context("a short message")?;
                ensure!(head[0] == 1, "opcode {}", head[0]);
                return Ok(Followed {
                    subscription: u32::from_le_bytes(head[1..5].try_into()?),
                    time_ns: u64::from_le_bytes(head[5..].try_into()?),
                    data: data.to_vec(),
                });
            }
        }
    }
}

/// A message of a channel.
struct Followed {
    subscription: u32,
    time_ns: u64,
    data: Vec<u8>,
}

fn utc_ns() -> anyhow::Result<u64> {
    Ok(u64::try_from(SystemTime::now().duration_since(UNIX_EPOCH)?.as_nanos())?)
}

fn check_status(status: &Value, part: &str) -> anyhow::Result<()> {
    ensure!(
        status["message"].as_str().is_some_and(|it| it.contains(part)),
        "no `{part}` in {status}"
    );
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn an_address_that_is_taken_costs_no_recording_and_is_tried_again() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("flight.mcap");
    let ([meet, port], _, _) = ports::free()?;
    let taken = std::net::TcpListener::bind(("127.0.0.1", port))?;
    let set = vec![format!("serve=127.0.0.1:{port}"), format!("file={path:?}")];
    let config = Layers { file: None, set }.load::<Config>()?.settings;
    let node = open("recorder", meet).await?;
    let task = tokio::spawn(recorder::run(node.clone(), config, Shutdown::on_signals()?));
    until("the recorder makes a file", TIMEOUT, async || path.is_file()).await?;
    let errors = node.health().report(node.identity(), 0).errors;
    ensure!(errors.iter().any(|it| it.reason.contains("viewers")), "{errors:?}");
    drop(taken);
    let is_reached = async || TcpStream::connect(("127.0.0.1", port)).await.is_ok();
    until("the recorder listens", TIMEOUT, is_reached).await?;
    ensure!(!task.is_finished(), "the recorder ended");
    task.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn messages_are_served_without_a_file_under_both_names_of_the_protocol() -> anyhow::Result<()>
{
    let served = Served::start(&["file="]).await?;
    let wind = served.blow();
    for subprotocol in [SUBPROTOCOLS[0], SUBPROTOCOLS[1], "other, foxglove.websocket.v1"] {
        let mut client = served.connected(served.request(subprotocol)?).await?;
        let channel = client.subscribe("wind", 42).await?;
        ensure!(channel["encoding"] == "json", "{channel}");
        ensure!(channel["schemaName"] == "alight.Wind", "{channel}");
        let mut last = None;
        for _ in 0..5 {
            let it = client.message().await?;
            ensure!(it.subscription == 42, "{}", it.subscription);
            ensure!(it.time_ns.abs_diff(utc_ns()?) < 5_000_000_000, "{}", it.time_ns);
            let value: Value = serde_json::from_slice(&it.data)?;
            let number = value["velocity_ned_m_s"][0].as_f64();
            ensure!(number > last, "{number:?} after {last:?}");
            last = number;
        }
        client.ask(&json!({ "op": "unsubscribe", "subscriptionIds": [42] })).await?;
        client.ask(&json!({ "op": "getParameters", "parameterNames": [] })).await?;
        check_status(&client.text("status").await?, "only subscribing")?;
        let unknown = json!([{ "id": 1, "channelId": 999 }]);
        client.ask(&json!({ "op": "subscribe", "subscriptions": unknown })).await?;
        check_status(&client.text("status").await?, "no channel 999")?;
        client.socket.close(None).await?;
    }
    wind.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_of_other_sites_and_too_many_clients_are_refused() -> anyhow::Result<()> {
    let served = Served::start(&["file=", "max_clients=2"]).await?;
    ensure!(served.refusal(served.request("mqtt")?).await? == 400);
    let mut foreign_page = served.request(SUBPROTOCOLS[0])?;
    foreign_page.headers_mut().insert("origin", HeaderValue::from_static("https://evil.example"));
    ensure!(served.refusal(foreign_page).await? == 403);
    let mut page = served.request(SUBPROTOCOLS[0])?;
    page.headers_mut().insert("origin", HeaderValue::from_static("https://app.foxglove.dev"));
    let _first = served.connected(page).await?;
    let second = served.client().await?;
    ensure!(served.refusal(served.request(SUBPROTOCOLS[0])?).await? == 503);
    drop(second);
    let is_free = async || served.client().await.is_ok();
    until("the place of a client that disconnected is free", TIMEOUT, is_free).await?;
    for reason in ["other protocol", "wrong Origin", "too many clients"] {
        ensure!(served.dropped(reason) >= 1, "{reason}");
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_slow_client_gets_the_newest_and_slows_neither_another_nor_the_recording()
-> anyhow::Result<()> {
    with_second_try(one_is_slow).await
}

/// A client takes nothing for three seconds, in parallel with one that takes everything.
async fn one_is_slow() -> anyhow::Result<()> {
    const PAUSE_NS: u64 = 3_000_000_000;
    let folder = tempfile::tempdir()?;
    let file = format!("file={:?}", folder.path().join("flight.mcap"));
    let served = Served::start(&[&file]).await?;
    let statuses = served.node.subscriber(topic::RECORDER_STATUS, &["main"]).await?;
    let film = served.film();
    let mut slow = served.client().await?;
    slow.subscribe("camera/down/picture", 1).await?;
    let mut quick = served.client().await?;
    let channel = quick.subscribe("camera/down/picture", 2).await?;
    ensure!(channel["schemaName"] == "foxglove.RawImage", "{channel}");
    let stopped_ns = slow.message().await?.time_ns;
    let mut pictures = 0_u64;
    let end_ns = loop {
        let time_ns = quick.message().await?.time_ns;
        pictures += 1;
        if time_ns.saturating_sub(stopped_ns) >= PAUSE_NS {
            break time_ns;
        }
    };
    ensure!(pictures > 20, "the quick one got {pictures} pictures in 3 s");
    // The messages on their way when it stopped, then at once the newest.
    let mut old = 0;
    while slow.message().await?.time_ns + PAUSE_NS / 3 < end_ns {
        old += 1;
    }
    let missed = served.dropped("a viewer is too slow");
    println!(
        "{pictures} pictures in 3 s in parallel with a client that took none: it missed {missed}, and got {old} old ones"
    );
    ensure!(old <= 3 && missed > pictures / 2, "{old} old, {missed} missed of {pictures}");
    check_status(&slow.text("status").await?, "left out")?;
    let status = loop {
        let status = timeout(TIMEOUT, statuses.next()).await?.context("the status")?;
        let kept = status.kept.iter().find(|kept| kept.key == "camera/down/frame");
        if kept.is_some_and(|kept| kept.count > pictures) && status.free_bytes.is_some() {
            break status;
        }
    };
    ensure!(status.lost() == 0 && status.problem.is_none(), "{status:?}");
    film.abort();
    Ok(())
}
