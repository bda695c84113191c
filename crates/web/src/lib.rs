//! Answers to browsers and viewers over HTTP, whose connections are bounded in number and time.
//!
//! Each client that reaches the address can open connections and send nothing. Each connection takes a place until its request is
//! there, or its time is over. A WebSocket releases its place, as the handler counts WebSockets. An answer without end, as a video,
//! marks its connection as lasting, and ends it.

mod tls;

use std::convert::Infallible;
use std::future::ready;
use std::io::ErrorKind;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::extract::{ConnectInfo, Request};
use axum::middleware::map_request;
use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use node::{BoxFuture, HealthCounters};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Notify, Semaphore};
use tokio::time::{sleep, timeout};

use crate::tls::Begun;
pub use crate::tls::Tls;

/// Pause after an error of the system, as that there are too many open files.
const PAUSE: Duration = Duration::from_millis(500);
/// Maximum size of the lines in front of a request's body, in bytes.
const MAX_HEAD_BYTES: usize = 16_384;

/// How many connections there may be, and how long each may last.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Maximum number of connections that are no WebSockets; further ones wait until one ends.
    pub connections: usize,
    /// Maximum time until the head of a request is there, also of a further one.
    pub head: Duration,
    /// Maximum time of a connection that does not become a WebSocket and does not last.
    pub connection: Duration,
}

/// Encryption, and the answer to a connection without it.
#[derive(Clone)]
pub struct Encryption {
    /// The certificate.
    pub tls: Tls,
    /// Answers a connection that is not encrypted: where the encrypted page is.
    pub otherwise: Router,
}

/// The connection of a request; each request has it as an extension.
#[derive(Clone, Default)]
pub struct Connection(Arc<Shared>);

#[derive(Default)]
struct Shared {
    /// A request has come.
    has_asked: AtomicBool,
    lasts: AtomicBool,
    over: Notify,
}

/// As long as this is there, its connection lasts beyond [`Limits::connection`]; with it the connection ends, even if data are still
/// to be sent.
pub struct Lasting(Connection);

impl Connection {
    /// Lets this connection last.
    #[must_use]
    pub fn last(self) -> Lasting {
        self.0.lasts.store(true, Ordering::Relaxed);
        Lasting(self)
    }

    fn asked(&self, request: Request) -> Request {
        self.0.has_asked.store(true, Ordering::Relaxed);
        request
    }

    /// Waits for the end of its time.
    async fn over(&self, limit: Duration) {
        sleep(limit).await;
        if self.0.lasts.load(Ordering::Relaxed) {
            self.0.over.notified().await;
        }
    }
}

impl Drop for Lasting {
    fn drop(&mut self) {
        // One permit is stored, also when no task waits yet.
        self.0.0.over.notify_one();
    }
}

impl Default for Limits {
    /// 64 connections, 5 s for a head, and a minute for all: a page of 300 kB at 40 kbit/s.
    fn default() -> Self {
        Self { connections: 64, head: Duration::from_secs(5), connection: Duration::from_secs(60) }
    }
}

/// Answers each connection, encrypted if so configured, and counts timeouts in the health. Each request has
/// its peer's address as `ConnectInfo<SocketAddr>`.
pub fn serve(
    listener: TcpListener,
    router: Router,
    encryption: Option<Encryption>,
    limits: Limits,
    health: Arc<HealthCounters>,
) -> BoxFuture<'static, Infallible> {
    Box::pin(async move {
        let places = Arc::new(Semaphore::new(limits.connections));
        loop {
            // The semaphore is never closed; without a place one waits for the next.
            let Ok(place) = Arc::clone(&places).acquire_owned().await else { continue };
            let (stream, peer) = match listener.accept().await {
                Ok(accepted) => accepted,
                Err(problem) => {
                    if !is_of_the_peer(problem.kind()) {
                        health.failed("connections cannot be accepted");
                        tracing::warn!(%problem, "A connection could not be accepted");
                        sleep(PAUSE).await;
                    }
                    continue;
                }
            };
            // Small messages go at once.
            drop(stream.set_nodelay(true));
            let answering = begin(
                stream,
                peer,
                router.clone(),
                encryption.clone(),
                limits,
                Arc::clone(&health),
            );
            tokio::spawn(async move {
                answering.await;
                drop(place);
            });
        }
    })
}

/// Answers a connection, after its handshake where it is encrypted.
async fn begin(
    stream: TcpStream,
    peer: SocketAddr,
    router: Router,
    encryption: Option<Encryption>,
    limits: Limits,
    health: Arc<HealthCounters>,
) {
    let Some(Encryption { tls, otherwise }) = encryption else {
        return answer(stream, peer, router, limits, &health).await;
    };
    match timeout(limits.head, tls.begin(stream)).await {
        Ok(Ok(Begun::Encrypted(stream))) => answer(stream, peer, router, limits, &health).await,
        Ok(Ok(Begun::Plain(stream))) => answer(stream, peer, otherwise, limits, &health).await,
        // A browser that does not trust the certificate ends the handshake.
        Ok(Err(_)) => health.dropped("no encrypted connection"),
        Err(_) => health.dropped("a request took too long"),
    }
}

/// Whether an error is one of the connection that was about to be accepted.
fn is_of_the_peer(kind: ErrorKind) -> bool {
    use ErrorKind::{ConnectionAborted, ConnectionRefused, ConnectionReset};
    matches!(kind, ConnectionAborted | ConnectionRefused | ConnectionReset)
}

async fn answer<S>(
    stream: S,
    peer: SocketAddr,
    router: Router,
    limits: Limits,
    health: &HealthCounters,
) where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let connection = Connection::default();
    let asking = connection.clone();
    let router = router
        .layer(Extension(ConnectInfo(peer)))
        .layer(Extension(connection.clone()))
        .layer(map_request(move |request: Request| ready(asking.asked(request))));
    let answering = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(limits.head)
        .max_buf_size(MAX_HEAD_BYTES)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(router))
        .with_upgrades();
    tokio::select! {
        answered = answering => {
            // A browser keeps its connection for a next request, and lets it end.
            let has_asked = connection.0.has_asked.load(Ordering::Relaxed);
            if !has_asked && answered.is_err_and(|problem| problem.is_timeout()) {
                health.dropped("a request took too long");
            }
        }
        () = connection.over(limits.connection) => health.dropped("a connection took too long"),
    }
}
