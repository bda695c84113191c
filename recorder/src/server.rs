//! Serves a viewer's WebSocket (Foxglove, Lichtblick or another client of their protocol): origin checked,
//! subscriptions taken, messages sent within its window, pings.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use axum::Router;
use axum::extract::State;
use axum::extract::ws::{Message, WebSocket, WebSocketUpgrade};
use axum::http::header::{HOST, ORIGIN};
use axum::http::{HeaderMap, HeaderName, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::routing::any;
use flightlog::live::{Request, SUBPROTOCOLS, message_data, request, server_info, warning};
use node::HealthCounters;
use tokio::net::TcpListener;
use tokio::time::{interval, timeout};

use crate::guard::may_follow;
use crate::hub::{Hub, Slot};
use crate::outbox::Next;
use crate::window::Window;

/// Maximum size of a client's request, in bytes: it may subscribe to all channels at once.
const MAX_REQUEST_BYTES: usize = 100_000;
/// A message that a client does not take within this time is dropped, and its connection closed.
const SEND_TIMEOUT: Duration = Duration::from_secs(5);
/// Period in which a client receives a ping and a report of missed messages.
const LOOK_PERIOD: Duration = Duration::from_secs(2);

/// The state of the server.
pub(crate) struct Server {
    pub(crate) hub: Arc<Hub>,
    pub(crate) health: Arc<HealthCounters>,
    /// The name that viewers show.
    pub(crate) name: String,
    /// Names the run of this process.
    pub(crate) session: String,
    /// Pages of these origins may follow as well.
    pub(crate) origins: Vec<String>,
}

/// Answers each client that connects.
pub(crate) async fn serve(listener: TcpListener, server: Server) -> Infallible {
    let health = Arc::clone(&server.health);
    let router = Router::new().fallback(any(connect)).with_state(Arc::new(server));
    web::serve(listener, router, None, web::Limits::default(), health).await
}

async fn connect(
    State(server): State<Arc<Server>>,
    headers: HeaderMap,
    upgrade: WebSocketUpgrade,
) -> Response {
    std::future::ready(()).await;
    let refuse = |status: StatusCode, reason: &'static str, why: &'static str| {
        server.health.dropped(reason);
        (status, why).into_response()
    };
    let text = |name: HeaderName| headers.get(name).map(|it| it.to_str().unwrap_or("?"));
    if !may_follow(text(ORIGIN), text(HOST), &server.origins) {
        return refuse(
            StatusCode::FORBIDDEN,
            "wrong Origin",
            "Pages of this web site may not follow the flight; `origins` in the configuration of the recorder names those that may.",
        );
    }
    let upgrade = upgrade
        .protocols(SUBPROTOCOLS)
        .max_message_size(MAX_REQUEST_BYTES)
        .max_frame_size(MAX_REQUEST_BYTES);
    if upgrade.selected_protocol().is_none() {
        return refuse(
            StatusCode::BAD_REQUEST,
            "other protocol",
            "The Foxglove WebSocket protocol is spoken here: foxglove.sdk.v1 or foxglove.websocket.v1.",
        );
    }
    let Some(slot) = server.hub.join() else {
        return refuse(
            StatusCode::SERVICE_UNAVAILABLE,
            "too many clients",
            "As many as `max_clients` allows follow already; close one of them.",
        );
    };
    upgrade.on_upgrade(async move |mut socket| {
        // A client that disconnects is not a failure.
        if let Err(error) = follow(&server, &slot, &mut socket).await {
            tracing::debug!(problem = %error, "A client has gone");
        }
    })
}

/// Sends, or fails when the client takes too long.
async fn send(socket: &mut WebSocket, message: Message) -> anyhow::Result<()> {
    timeout(SEND_TIMEOUT, socket.send(message)).await.context("the client takes nothing")??;
    Ok(())
}

async fn ping(socket: &mut WebSocket, window: &mut Window) -> anyhow::Result<()> {
    let number = window.ping(Instant::now());
    send(socket, Message::Ping(number.to_le_bytes().to_vec().into())).await
}

/// Sends the messages to which a client subscribes, until it disconnects.
async fn follow(server: &Server, slot: &Slot, socket: &mut WebSocket) -> anyhow::Result<()> {
    send(socket, Message::Text(server_info(&server.name, &server.session).into())).await?;
    let mut window = Window::default();
    let mut look = interval(LOOK_PERIOD);
    let mut reported = 0;
    loop {
        // A message that finds the window full is sent after the pong.
        while window.has_room()
            && let Some(next) = slot.next()
        {
            let (message, bytes) = match next {
                Next::Text(text) => (Message::Text(text.into()), 0),
                Next::Message(subscription, it) => {
                    let bytes = message_data(subscription, it.log_time_ns, &it.data);
                    let length = bytes.len();
                    (Message::Binary(bytes.into()), length)
                }
            };
            send(socket, message).await?;
            if window.sent(bytes) {
                ping(socket, &mut window).await?;
            }
        }
        tokio::select! {
            () = slot.changed() => {}
            received = socket.recv() => match received.context("it closed the connection")?? {
                Message::Text(text) => answer(server, slot, socket, &text).await?,
                Message::Pong(number) => {
                    if let Ok(number) = <[u8; 8]>::try_from(&*number) {
                        window.pong(u64::from_le_bytes(number));
                    }
                }
                Message::Close(_) => return Ok(()),
                Message::Binary(_) | Message::Ping(_) => {}
            },
            _ = look.tick() => {
                if window.is_stuck(Instant::now()) {
                    server.health.dropped("client takes nothing");
                    bail!("it takes nothing");
                }
                ping(socket, &mut window).await?;
                let dropped = slot.dropped();
                if dropped > reported {
                    reported = dropped;
                    let text = format!(
                        "{dropped} older messages were left out so far, as the connection or the viewer is too slow for all of them"
                    );
                    send(socket, Message::Text(warning("dropped", &text).into())).await?;
                }
            }
        }
    }
}

/// Carries out a client's request, or sends why not.
async fn answer(
    server: &Server,
    slot: &Slot,
    socket: &mut WebSocket,
    text: &str,
) -> anyhow::Result<()> {
    let errors: Vec<String> = match request(text) {
        Ok(Request::Subscribe { subscriptions }) => {
            subscriptions.into_iter().filter_map(|it| slot.subscribe(it).err()).collect()
        }
        Ok(Request::Unsubscribe { subscription_ids }) => {
            subscription_ids.into_iter().for_each(|id| slot.unsubscribe(id));
            Vec::new()
        }
        Ok(Request::Other) => vec!["only subscribing and unsubscribing are offered".to_owned()],
        Err(error) => vec![error],
    };
    if let Some(error) = errors.first() {
        server.health.dropped("wrong request");
        let text = format!("this was not done: {error}");
        send(socket, Message::Text(warning("request", &text).into())).await?;
    }
    Ok(())
}
