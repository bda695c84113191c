//! Serves the page by HTTP: its files, WebSockets with the state and with pictures, Motion JPEG, login by a token, and commands
//! with their nonce. The guard checks each request.

use std::convert::Infallible;
use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::Context;
use axum::Router;
use axum::body::Body;
use axum::extract::ws::{Message, Utf8Bytes, WebSocket, WebSocketUpgrade};
use axum::extract::{ConnectInfo, DefaultBodyLimit, Extension, Request, State as Shared};
use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, COOKIE, HOST, LOCATION, ORIGIN,
    REFERRER_POLICY, SET_COOKIE, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::Response;
use axum::routing::{get, post};
use messages::{ControllerCommand, Place, topic};
use node::{Node, boot_ahead_ns, host_name, now_ns};
use serde::Deserialize;
use serde_json::json;
use tokio::net::TcpListener;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, watch};
use tokio::time::{interval, timeout};
use web::Tls;

use crate::config::Config;
use crate::guard::{Access, Guard, Refusal};
use crate::log::Level;
use crate::mjpeg;
use crate::nonce::Nonce;
use crate::state::State;
use crate::tokens::{Kind, SESSION_S, Sessions, Tokens, secret, usual_file};
use crate::video::{Pictures, Shown};
use crate::window::Window;

/// The files of the page: path, type, contents.
const FILES: [(&str, &str, &str); 9] = [
    ("/", HTML, include_str!("../page/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("../page/style.css")),
    ("/icon.svg", "image/svg+xml", include_str!("../page/icon.svg")),
    ("/app.js", JAVASCRIPT, include_str!("../page/app.js")),
    ("/hold.js", JAVASCRIPT, include_str!("../page/hold.js")),
    ("/map.js", JAVASCRIPT, include_str!("../page/map.js")),
    ("/picture.js", JAVASCRIPT, include_str!("../page/picture.js")),
    ("/strips.js", JAVASCRIPT, include_str!("../page/strips.js")),
    ("/worker.js", JAVASCRIPT, include_str!("../page/worker.js")),
];
const HTML: &str = "text/html; charset=utf-8";
const JAVASCRIPT: &str = "text/javascript; charset=utf-8";
const JSON: &str = "application/json";

/// The page loads everything from its own origin, and no inline script is run.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; worker-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Maximum size of a message or request of a browser, in bytes.
const MAX_REQUEST_BYTES: usize = 4096;
/// A browser that does not take a message within this time is disconnected.
const SEND_TIMEOUT: Duration = Duration::from_secs(5);
/// Period in which the rights of a connected browser are checked again: its token may have been removed.
const ACCESS_PERIOD: Duration = Duration::from_secs(1);
/// Period in which a browser with pictures is checked for progress.
const LOOK_PERIOD: Duration = Duration::from_millis(500);
/// Maximum age of the first picture that a browser gets, in nanoseconds.
const MAX_FIRST_AGE_NS: i64 = 1_000_000_000;
/// Maximum number of replies that wait to be sent to a browser, and of its commands in progress.
const MAX_COMMANDS: usize = 4;
/// Messages by which a browser requests the refused candidates with each picture, and ends that request.
const REFUSED: &str = "refused";
const NOTHING_REFUSED: &str = "nothing refused";
/// Time for which a button is held, in milliseconds.
const HOLD_MS: u32 = 1000;

/// The messages to all browsers, each as JSON.
#[derive(Clone, Default)]
pub(crate) struct Texts {
    pub(crate) now: Arc<watch::Sender<Utf8Bytes>>,
    pub(crate) slow: Arc<watch::Sender<Utf8Bytes>>,
    /// The version of the log. Its text is made when it is sent: a browser subtracts the ages of the entries from the time of
    /// arrival, which may be long after the last entry.
    pub(crate) log: Arc<watch::Sender<u64>>,
}

/// The data shared by all requests.
pub(crate) struct App {
    node: Node,
    guard: Guard,
    config: Config,
    cookie: String,
    sessions: Mutex<Sessions>,
    state: Arc<Mutex<State>>,
    texts: Texts,
    pictures: Pictures,
    tls: Option<Tls>,
    clients: Arc<Semaphore>,
    viewers: Arc<Semaphore>,
}

/// A request of a browser.
#[derive(Deserialize)]
#[serde(rename_all = "kebab-case", tag = "kind")]
enum Ask {
    /// A nonce for a command; the answer has the same number of the press of the button.
    Nonce { command: String, argument: Option<String>, press: Option<u64> },
    /// The execution of a command.
    Command { command: String, argument: Option<String>, nonce: String },
    /// The server's time.
    Ping { at_ms: f64 },
}

impl App {
    pub(crate) fn new(
        node: Node,
        config: &Config,
        address: SocketAddr,
        state: Arc<Mutex<State>>,
        texts: Texts,
        pictures: Pictures,
    ) -> anyhow::Result<Arc<Self>> {
        let commands = node::named(&config.commands).map_err(anyhow::Error::msg)?;
        let files = config.certificate();
        let tls = files.map(|[certificate, key]| Tls::read(&certificate, &key)).transpose();
        let tls = tls.context("`certificate` of the dashboard, which encrypts the page")?;
        let max_clients = config.max_clients as usize;
        Ok(Arc::new(Self {
            node,
            guard: Guard::new(address, config.names.clone(), commands, tls.is_some()),
            config: config.clone(),
            // Cookies are shared by the ports of a machine.
            cookie: format!("alight-{}", address.port()),
            sessions: Mutex::default(),
            state,
            texts,
            pictures,
            tls,
            clients: Arc::new(Semaphore::new(max_clients)),
            viewers: Arc::new(Semaphore::new(max_clients)),
        }))
    }

    /// The beginning of the page's address.
    pub(crate) fn scheme(&self) -> &'static str {
        self.guard.scheme()
    }

    /// The value of this page's cookie in a request.
    fn cookie<'a>(&self, headers: &'a HeaderMap) -> Option<&'a str> {
        let cookies = headers.get_all(COOKIE).iter().filter_map(|value| value.to_str().ok());
        let mut cookies = cookies.flat_map(|text| text.split(';'));
        cookies.find_map(|it| it.trim().strip_prefix(&self.cookie)?.strip_prefix('='))
    }

    /// Identifies the client and its rights.
    fn admit(self: &Arc<Self>, peer: SocketAddr, headers: &HeaderMap) -> Result<Peer, Refusal> {
        let cookie = self.cookie(headers).map(str::to_owned);
        let access = self.access(peer.ip(), cookie.as_deref())?;
        Ok(Peer { app: Arc::clone(self), peer: peer.ip(), cookie, access })
    }

    fn access(&self, peer: IpAddr, cookie: Option<&str>) -> Result<Access, Refusal> {
        let session = cookie.and_then(|cookie| {
            let tokens = tokio::task::block_in_place(|| Tokens::read_open(&self.token_file()?));
            if let Err(error) = &tokens
                && self.node.health().failed("tokens")
            {
                tracing::warn!(
                    error = format!("{error:#}"),
                    "The tokens cannot be read: after a minute all sessions end"
                );
                self.log(Level::Warn, "the tokens cannot be read: after a minute all sessions end");
            }
            let mut sessions = self.sessions();
            let now_ns = session_ns();
            sessions.end_invalid(tokens.as_ref().ok(), now_ns);
            sessions.kind(cookie, now_ns)
        });
        self.guard.access(peer, session)
    }

    fn sessions(&self) -> MutexGuard<'_, Sessions> {
        self.sessions.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn log(&self, level: Level, text: &str) {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.log.add(now_ns(), level, text);
    }

    fn log_text(&self) -> Utf8Bytes {
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.log_json(now_ns()).to_string().into()
    }

    /// Counts a refusal, and gives the reason.
    fn refuse(&self, refusal: Refusal) -> Response {
        self.node.health().dropped(refusal.reason());
        let status = match refusal {
            Refusal::Host => StatusCode::MISDIRECTED_REQUEST,
            Refusal::Origin => StatusCode::FORBIDDEN,
            Refusal::Token => StatusCode::UNAUTHORIZED,
            Refusal::Full => StatusCode::SERVICE_UNAVAILABLE,
            Refusal::Plain => StatusCode::UPGRADE_REQUIRED,
        };
        let why = json!({ "reason": refusal.reason(), "why": refusal.sentence() });
        answer(status, JSON, why.to_string())
    }

    fn token_file(&self) -> anyhow::Result<PathBuf> {
        let named = &self.config.tokens;
        if named.as_os_str().is_empty() { usual_file() } else { Ok(named.clone()) }
    }
}

/// An admitted client.
struct Peer {
    app: Arc<App>,
    peer: IpAddr,
    cookie: Option<String>,
    access: Access,
}

impl Peer {
    /// Returns when the client's rights have changed, as its token was removed or has expired.
    async fn access_changed(&self) {
        let mut look = interval(ACCESS_PERIOD);
        loop {
            look.tick().await;
            if self.app.access(self.peer, self.cookie.as_deref()).as_ref() != Ok(&self.access) {
                return;
            }
        }
    }
}

/// Seconds since 1970, the time scale of the tokens' expiry.
fn now_s() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()
}

/// Nanoseconds of the clock of sessions, which is monotonic and includes the time in which the host sleeps.
fn session_ns() -> i64 {
    now_ns().saturating_add(boot_ahead_ns())
}

fn answer(status: StatusCode, kind: &'static str, body: impl Into<Body>) -> Response {
    let mut response = Response::new(body.into());
    *response.status_mut() = status;
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    response
}

/// Serves all connections.
pub(crate) async fn serve(listener: TcpListener, app: Arc<App>) -> Infallible {
    let health = app.node.shared_health();
    let mut router = Router::new();
    for (path, kind, contents) in FILES {
        router = router.route(path, get(async move || answer(StatusCode::OK, kind, contents)));
    }
    let router = router
        .route("/session", get(session))
        .route("/login", post(login))
        .route("/logout", post(logout))
        .route("/ws", get(data))
        .route("/video", get(video))
        .route("/video.mjpeg", get(motion_jpeg))
        .layer(DefaultBodyLimit::max(MAX_REQUEST_BYTES))
        .layer(from_fn_with_state(Arc::clone(&app), protect))
        .with_state(Arc::clone(&app));
    let encryption = app.tls.clone().map(|tls| web::Encryption {
        tls,
        otherwise: Router::new().fallback(moved).with_state(app),
    });
    web::serve(listener, router, encryption, web::Limits::default(), health).await
}

/// Redirects requests for the page without encryption to the encrypted one; all other requests are refused.
async fn moved(Shared(app): Shared<Arc<App>>, request: Request) -> Response {
    std::future::ready(()).await;
    let host = request.headers().get(HOST).and_then(|host| host.to_str().ok());
    if request.method() != Method::GET || request.uri().path() != "/" {
        return app.refuse(Refusal::Plain);
    }
    if let Err(refusal) = app.guard.check_headers(host, None) {
        return app.refuse(refusal);
    }
    let page = HeaderValue::from_str(&format!("https://{}/", host.unwrap_or_default()));
    let Ok(page) = page else { return app.refuse(Refusal::Host) };
    let mut response = answer(StatusCode::TEMPORARY_REDIRECT, HTML, "");
    response.headers_mut().insert(LOCATION, page);
    response
}

/// Checks every request before anything else, and adds the headers that restrict the page in the browser.
async fn protect(Shared(app): Shared<Arc<App>>, request: Request, next: Next) -> Response {
    let checked = {
        // A value that is not text is not an address of this page.
        let text = |value: &'_ HeaderValue| value.to_str().unwrap_or("?").to_owned();
        let [host, origin] = [HOST, ORIGIN].map(|name| request.headers().get(name).map(text));
        app.guard.check_headers(host.as_deref(), origin.as_deref())
    };
    let mut response = match checked {
        Ok(()) => next.run(request).await,
        Err(refusal) => app.refuse(refusal),
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (CONTENT_SECURITY_POLICY, POLICY),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (REFERRER_POLICY, "no-referrer"),
        (CACHE_CONTROL, "no-store"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

/// The rights of this browser, or the reason for a refusal: a page cannot see why its WebSocket is refused.
async fn session(
    Shared(app): Shared<Arc<App>>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
) -> Response {
    let has_room = app.clients.available_permits() > 0;
    let admitted = app.admit(peer, &headers);
    let admitted = admitted.and_then(|it| has_room.then_some(it).ok_or(Refusal::Full));
    std::future::ready(match admitted {
        Ok(peer) => {
            let text = json!({ "no_commands": peer.access.no_commands }).to_string();
            answer(StatusCode::OK, JSON, text)
        }
        Err(refusal) => app.refuse(refusal),
    })
    .await
}

/// Begins a session for a token.
async fn login(Shared(app): Shared<Arc<App>>, token: String) -> Response {
    let tokens = tokio::task::block_in_place(|| Tokens::read(&app.token_file()?));
    let tokens = tokens.unwrap_or_else(|error| {
        app.node.health().failed("tokens");
        tracing::warn!(error = format!("{error:#}"), "No token is accepted");
        Tokens::default()
    });
    let token = tokens.of(&token, now_s()).cloned();
    let begun = token.and_then(|token| Some((token, secret().ok()?)));
    let Some((token, cookie)) = begun else { return app.refuse(Refusal::Token) };
    let kind = token.kind;
    app.sessions().begin(&cookie, token, now_s(), session_ns());
    app.log(Level::Info, &format!("a browser has presented a token of the kind `{kind}`"));
    let secure = if app.tls.is_some() { "; Secure" } else { "" };
    let cookie = format!(
        "{}={cookie}; HttpOnly; SameSite=Strict; Path=/; Max-Age={SESSION_S}{secure}",
        app.cookie
    );
    let is_command = kind == Kind::Command;
    let mut response = answer(StatusCode::OK, JSON, json!({ "command": is_command }).to_string());
    if let Ok(value) = HeaderValue::from_str(&cookie) {
        response.headers_mut().insert(SET_COOKIE, value);
    }
    response
}

/// Ends a session.
async fn logout(Shared(app): Shared<Arc<App>>, headers: HeaderMap) -> Response {
    if let Some(cookie) = app.cookie(&headers) {
        app.sessions().end(cookie);
    }
    std::future::ready(answer(StatusCode::OK, JSON, "{}")).await
}

async fn data(
    Shared(app): Shared<Arc<App>>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    upgrade: WebSocketUpgrade,
) -> Response {
    let permit = Arc::clone(&app.clients).try_acquire_owned().map_err(|_| Refusal::Full);
    match std::future::ready(app.admit(peer, &headers).and_then(|it| Ok((it, permit?)))).await {
        Ok((peer, permit)) => {
            bounded(upgrade).on_upgrade(move |socket| Client::new(peer).run(socket, permit))
        }
        Err(refusal) => app.refuse(refusal),
    }
}

async fn video(
    Shared(app): Shared<Arc<App>>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    upgrade: WebSocketUpgrade,
) -> Response {
    let permit = Arc::clone(&app.viewers).try_acquire_owned().map_err(|_| Refusal::Full);
    match std::future::ready(app.admit(peer, &headers).and_then(|it| Ok((it, permit?)))).await {
        Ok((peer, permit)) => bounded(upgrade).on_upgrade(async move |socket| {
            tokio::select! {
                () = pictures(&peer.app, socket, permit) => {}
                () = peer.access_changed() => {}
            }
        }),
        Err(refusal) => app.refuse(refusal),
    }
}

/// Serves video for other programs, such as ground stations, and for browsers without bitmaps. It has no detections, as the page
/// draws them.
async fn motion_jpeg(
    Shared(app): Shared<Arc<App>>,
    ConnectInfo(peer): ConnectInfo<SocketAddr>,
    Extension(connection): Extension<web::Connection>,
    headers: HeaderMap,
) -> Response {
    let permit = Arc::clone(&app.viewers).try_acquire_owned().map_err(|_| Refusal::Full);
    match std::future::ready(app.admit(peer, &headers).and_then(|it| Ok((it, permit?)))).await {
        Ok((peer, permit)) => {
            let end = async move { peer.access_changed().await };
            mjpeg::answer(app.pictures.files.subscribe(), connection, end, permit)
        }
        Err(refusal) => app.refuse(refusal),
    }
}

fn bounded(upgrade: WebSocketUpgrade) -> WebSocketUpgrade {
    upgrade.max_message_size(MAX_REQUEST_BYTES).max_frame_size(MAX_REQUEST_BYTES)
}

/// Sends, or fails when the browser takes too long.
async fn send(socket: &mut WebSocket, message: Message) -> anyhow::Result<()> {
    timeout(SEND_TIMEOUT, socket.send(message)).await.context("the browser receives nothing")??;
    Ok(())
}

/// Sends pictures, the newest one whenever the browser has drawn one.
async fn pictures(app: &App, mut socket: WebSocket, _permit: OwnedSemaphorePermit) {
    let mut shown = app.pictures.shown.subscribe();
    // The newest picture is an old one when the camera has stopped.
    let newest_ns = shown.borrow().as_ref().map(|it| it.at_ns);
    if newest_ns.is_some_and(|at_ns| now_ns() - at_ns <= MAX_FIRST_AGE_NS) {
        shown.mark_changed();
    }
    let mut window = Window::default();
    // While this receiver exists, detectors publish refused candidates.
    let mut refused: Option<watch::Receiver<()>> = None;
    let mut look = interval(LOOK_PERIOD);
    loop {
        tokio::select! {
            // It never ends while `app` exists.
            changed = shown.changed(), if window.has_room() => {
                if changed.is_err() {
                    return;
                }
                let Some(Shown { number, message, .. }) = shown.borrow_and_update().clone() else { continue };
                window.sent(now_ns(), number);
                if send(&mut socket, Message::Binary(message)).await.is_err() {
                    return;
                }
            }
            received = socket.recv() => match received {
                Some(Ok(Message::Text(text))) => match text.as_str() {
                    REFUSED => drop(refused.replace(app.pictures.show_refused.subscribe())),
                    NOTHING_REFUSED => drop(refused.take()),
                    // An acknowledgement: the number of the picture that was drawn.
                    number => {
                        if !number.parse().is_ok_and(|it| window.acknowledged(now_ns(), it)) {
                            app.node.health().dropped("wrong acknowledgement");
                        }
                    }
                },
                Some(Ok(Message::Close(_)) | Err(_)) | None => return,
                Some(Ok(_)) => {}
            },
            _ = look.tick() => {
                if window.is_stuck(now_ns()) {
                    app.node.health().dropped("browser draws nothing");
                    return;
                }
            }
        }
    }
}

/// A browser that shows the page.
struct Client {
    peer: Arc<Peer>,
    nonce: Nonce,
    replies: mpsc::Sender<Utf8Bytes>,
    waiting: mpsc::Receiver<Utf8Bytes>,
}

impl Client {
    fn new(peer: Peer) -> Self {
        let (replies, waiting) = mpsc::channel(MAX_COMMANDS);
        Self { peer: Arc::new(peer), nonce: Nonce::default(), replies, waiting }
    }

    async fn run(mut self, mut socket: WebSocket, _permit: OwnedSemaphorePermit) {
        let peer = Arc::clone(&self.peer);
        tokio::select! {
            // A browser that disconnects is not a failure.
            end = self.exchange(&mut socket) => tracing::debug!(?end, "A browser has disconnected"),
            () = peer.access_changed() => tracing::debug!("The rights of a browser have changed"),
        }
    }

    async fn exchange(&mut self, socket: &mut WebSocket) -> anyhow::Result<()> {
        let hello = json!({
            "kind": "hello", "version": node::version(), "host": host_name(), "vehicle": self.peer.app.node.vehicle(),
            "no_commands": self.peer.access.no_commands, "needs_token": self.peer.access.needs_token, "hold_ms": HOLD_MS, "video": self.peer.app.config.video.input,
        });
        send(socket, Message::Text(hello.to_string().into())).await?;
        let texts = self.peer.app.texts.clone();
        let [mut now, mut slow] = [texts.now, texts.slow].map(|text| {
            let mut text = text.subscribe();
            text.mark_changed();
            text
        });
        let mut log = texts.log.subscribe();
        log.mark_changed();
        loop {
            let text = tokio::select! {
                changed = log.changed() => { changed?; self.peer.app.log_text() }
                changed = slow.changed() => { changed?; slow.borrow_and_update().clone() }
                changed = now.changed() => { changed?; now.borrow_and_update().clone() }
                Some(reply) = self.waiting.recv() => reply,
                received = socket.recv() => match received {
                    Some(Ok(Message::Text(text))) => match self.asked(&text) {
                        Some(answer) => answer,
                        None => continue,
                    },
                    Some(Ok(Message::Close(_))) | None => return Ok(()),
                    Some(Ok(_)) => continue,
                    Some(Err(error)) => return Err(error.into()),
                },
            };
            if !text.as_str().is_empty() {
                send(socket, Message::Text(text)).await?;
            }
        }
    }

    /// The answer to a request of a browser; that to a command follows later.
    fn asked(&mut self, text: &str) -> Option<Utf8Bytes> {
        let Ok(ask) = serde_json::from_str(text) else {
            self.peer.app.node.health().dropped("unreadable request");
            return Some(
                json!({ "kind": "problem", "why": "unreadable request" }).to_string().into(),
            );
        };
        match ask {
            Ask::Ping { at_ms } => {
                let pong =
                    json!({ "kind": "pong", "at_ms": at_ms, "now_ms": now_ns() as f64 * 1e-6 });
                Some(pong.to_string().into())
            }
            Ask::Nonce { command, argument, press } => {
                let mut random = [0; 16];
                if getrandom::fill(&mut random).is_err() {
                    return Some(refused(
                        &command,
                        "dashboard",
                        "the system has no random numbers",
                    ));
                }
                let nonce =
                    self.nonce.open(now_ns(), random, &full_command(&command, argument.as_deref()));
                let answer = json!({ "kind": "nonce", "command": command, "argument": argument, "press": press, "nonce": nonce });
                Some(answer.to_string().into())
            }
            Ask::Command { command, argument, nonce } => {
                let full = full_command(&command, argument.as_deref());
                let checked = self.nonce.spend(now_ns(), &nonce, &full);
                if let Some(why) = self.peer.access.no_commands {
                    self.peer.app.node.health().dropped("command without the right");
                    return Some(refused(&full, "dashboard", why));
                }
                if let Err(error) = checked {
                    self.peer.app.node.health().dropped(error.reason());
                    self.peer.app.log(
                        Level::Warn,
                        &format!("{full}: refused by the dashboard: {}", error.sentence()),
                    );
                    return Some(refused(&full, "dashboard", error.sentence()));
                }
                let Some(parsed) = parse(&command, argument) else {
                    return Some(refused(&full, "dashboard", "there is no such command"));
                };
                self.execute(full, parsed);
                None
            }
        }
    }

    fn execute(&self, full: String, command: ControllerCommand) {
        let (app, replies) = (Arc::clone(&self.peer.app), self.replies.clone());
        tokio::spawn(async move {
            let reply = app.node.command(topic::COMMAND, &[], &command).await;
            // A command without an answer may have been carried out.
            let (accepted, verdict, who, reason) = match reply {
                Ok(reply) if reply.accepted => {
                    (true, "accepted by the controller", "controller", reply.reason)
                }
                Ok(reply) => (false, "refused by the controller", "controller", reply.reason),
                Err(error) => (false, "no answer", NO_PEER, format!("{error:#}")),
            };
            app.node.health().count("commands");
            let level = if accepted { Level::Info } else { Level::Warn };
            tracing::info!(command = full, verdict, reason, "A browser's command");
            app.log(level, &format!("operator: {full}: {verdict}: {reason}"));
            let text = reply_json(&full, accepted, who, &reason);
            // The browser may have disconnected.
            drop(replies.send(text).await);
        });
    }
}

/// The answering process in a reply without an answer.
const NO_PEER: &str = "nobody";

/// A command with its argument, for comparison and display.
fn full_command(command: &str, argument: Option<&str>) -> String {
    match argument {
        Some(argument) => format!("{command} {argument}"),
        None => command.to_owned(),
    }
}

fn refused(command: &str, who: &str, why: &str) -> Utf8Bytes {
    reply_json(command, false, who, why)
}

fn reply_json(command: &str, accepted: bool, who: &str, why: &str) -> Utf8Bytes {
    let reply = json!({ "kind": "reply", "command": command, "accepted": accepted, "who": who, "why": why });
    reply.to_string().into()
}

/// The controller's command.
fn parse(command: &str, argument: Option<String>) -> Option<ControllerCommand> {
    Some(match (command, argument) {
        ("start", None) => ControllerCommand::Start,
        ("hold", None) => ControllerCommand::Hold,
        ("resume", None) => ControllerCommand::Resume,
        ("abort", None) => ControllerCommand::Abort,
        ("land-here", None) => ControllerCommand::LandHere,
        ("use-detector", Some(name)) if node::config::is_name(&name) => {
            ControllerCommand::UseDetector(name)
        }
        ("prefer", Some(place)) if place == Place::Onboard.name() => {
            ControllerCommand::PreferDetectors(Place::Onboard)
        }
        ("prefer", Some(place)) if place == Place::Ground.name() => {
            ControllerCommand::PreferDetectors(Place::Ground)
        }
        ("prefer", Some(place)) if place == "any" => ControllerCommand::PreferAnyDetector,
        _ => return None,
    })
}
