//! Tests connections that send nothing, little, or continue.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use axum::body::{Body, Bytes};
use axum::extract::ConnectInfo;
use axum::extract::ws::{Message, WebSocketUpgrade};
use axum::response::Response;
use axum::routing::get;
use axum::{Extension, Router};
use futures_util::{StreamExt, stream};
use node::HealthCounters;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;
use tokio::time::{sleep, timeout};
use tokio_tungstenite::connect_async;
use web::{Connection, Limits, serve};

const PATIENCE: Duration = Duration::from_secs(20);
const LIMITS: Limits = Limits {
    connections: 4,
    head: Duration::from_millis(300),
    connection: Duration::from_millis(1500),
};

async fn slowly() -> &'static str {
    sleep(Duration::from_secs(60)).await;
    "late"
}

async fn peer_address(ConnectInfo(peer): ConnectInfo<SocketAddr>) -> String {
    peer.ip().to_string()
}

async fn socket(upgrade: WebSocketUpgrade) -> Response {
    std::future::ready(()).await;
    upgrade.on_upgrade(|mut socket| async move {
        for _ in 0..30 {
            sleep(Duration::from_millis(100)).await;
            if socket.send(Message::Text("still here".into())).await.is_err() {
                return;
            }
        }
    })
}

/// The connection of an answer without end, which ends when the client has taken nothing for 300 ms; it takes a second to begin.
async fn video(Extension(connection): Extension<Connection>) -> Body {
    let (parts, waiting) = mpsc::channel::<Bytes>(1);
    let lasting = connection.last();
    tokio::spawn(async move {
        let part = Bytes::from_static(&[b'x'; 100_000]);
        for _ in 0..300 {
            sleep(Duration::from_millis(10)).await;
            if !timeout(LIMITS.head, parts.send(part.clone())).await.is_ok_and(|it| it.is_ok()) {
                break;
            }
        }
        drop(lasting);
    });
    Body::from_stream(stream::unfold(waiting, async |mut waiting| {
        waiting.recv().await.map(|part| (Ok::<_, Infallible>(part), waiting))
    }))
}

struct Served {
    address: SocketAddr,
    health: Arc<HealthCounters>,
}

async fn served() -> anyhow::Result<Served> {
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    let address = listener.local_addr()?;
    let health = Arc::new(HealthCounters::default());
    let router = Router::new()
        .route("/who", get(peer_address))
        .route("/slowly", get(slowly))
        .route("/video", get(video))
        .route("/socket", get(socket));
    tokio::spawn(serve(listener, router, None, LIMITS, Arc::clone(&health)));
    Ok(Served { address, health })
}

/// The answer, until the connection is closed.
async fn ask(address: SocketAddr, text: &str) -> anyhow::Result<String> {
    let mut stream = TcpStream::connect(address).await?;
    stream.write_all(text.as_bytes()).await?;
    rest(&mut stream).await
}

async fn rest(stream: &mut TcpStream) -> anyhow::Result<String> {
    let mut answer = String::new();
    timeout(PATIENCE, stream.read_to_string(&mut answer)).await.context("it stays open")??;
    Ok(answer)
}

#[tokio::test(flavor = "multi_thread")]
async fn connections_that_send_nothing_or_little_are_closed() -> anyhow::Result<()> {
    let served = served().await?;
    for said in ["", "GET /who HT", "GET /who HTTP/1.1\r\nHost: x\r\n"] {
        let began = Instant::now();
        let answer = ask(served.address, said).await?;
        ensure!(!answer.contains("200"), "{said:?}: {answer}");
        ensure!(began.elapsed() >= LIMITS.head, "{said:?}: {:?}", began.elapsed());
    }
    let health = format!("{:?}", served.health);
    ensure!(health.contains("a request took too long"), "{health}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_connection_that_was_answered_and_waits_for_no_more_is_no_fault() -> anyhow::Result<()> {
    let served = served().await?;
    let answer = ask(served.address, "GET /who HTTP/1.1\r\nHost: x\r\n\r\n").await?;
    ensure!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    let health = format!("{:?}", served.health);
    ensure!(!health.contains("took too long"), "{health}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn silent_connections_do_not_block_other_clients() -> anyhow::Result<()> {
    let served = served().await?;
    let mut silent = Vec::new();
    for _ in 0..3 * LIMITS.connections {
        silent.push(TcpStream::connect(served.address).await?);
    }
    let request = "GET /who HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n";
    let answer = ask(served.address, request).await?;
    ensure!(answer.starts_with("HTTP/1.1 200") && answer.ends_with("127.0.0.1"), "{answer}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn an_answer_that_never_comes_ends_with_its_connection() -> anyhow::Result<()> {
    let served = served().await?;
    let answer = ask(served.address, "GET /slowly HTTP/1.1\r\nHost: x\r\n\r\n").await?;
    ensure!(answer.is_empty(), "{answer}");
    let health = format!("{:?}", served.health);
    ensure!(health.contains("a connection took too long"), "{health}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_websocket_lasts_and_takes_no_place() -> anyhow::Result<()> {
    let served = served().await?;
    let mut sockets = Vec::new();
    for _ in 0..2 * LIMITS.connections {
        let address = format!("ws://{}/socket", served.address);
        sockets.push(timeout(PATIENCE, connect_async(address)).await??.0);
    }
    for socket in &mut sockets {
        let mut messages = 0;
        while let Some(Ok(message)) = timeout(PATIENCE, socket.next()).await? {
            messages += u32::from(message.is_text());
        }
        ensure!(messages == 30, "{messages} of 30 messages in 3 s");
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_lasting_answer_continues_until_its_handler_ends_it() -> anyhow::Result<()> {
    let served = served().await?;
    let request = b"GET /video HTTP/1.1\r\nHost: x\r\n\r\n";
    let mut stream = TcpStream::connect(served.address).await?;
    let began = Instant::now();
    stream.write_all(request).await?;
    let answer = rest(&mut stream).await?;
    // Data that were not sent at its end are lost.
    ensure!(answer.len() > 250 * 100_000, "{} bytes", answer.len());
    ensure!(began.elapsed() > LIMITS.connection, "{:?}", began.elapsed());

    // A client that takes nothing receives the system's buffered data, and then a closed connection.
    let mut stuck = TcpStream::connect(served.address).await?;
    stuck.write_all(request).await?;
    sleep(LIMITS.connection + Duration::from_secs(2)).await;
    let answer = rest(&mut stuck).await.unwrap_or_default();
    ensure!(answer.len() < 250 * 100_000, "{} bytes", answer.len());
    Ok(())
}
