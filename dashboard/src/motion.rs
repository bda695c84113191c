//! Motion JPEG: pictures one after the other in an answer without end (multipart/x-mixed-replace).

use std::convert::Infallible;
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::http::HeaderValue;
use axum::http::header::CONTENT_TYPE;
use axum::response::Response;
use futures_util::stream::unfold;
use tokio::sync::{OwnedSemaphorePermit, mpsc, watch};
use tokio::time::timeout;
use web::{Connection, Lasting};

use crate::video::Shown;

const KIND: HeaderValue = HeaderValue::from_static("multipart/x-mixed-replace; boundary=picture");
const BOUNDARY: &[u8] = b"--picture\r\n";
/// Who takes no picture within this time is given up with its connection.
const SEND_TIMEOUT: Duration = Duration::from_secs(5);

/// The answer with the pictures that come, the newest whenever one was taken.
pub(crate) fn answer(
    shown: watch::Receiver<Option<Shown>>,
    connection: Connection,
    permit: OwnedSemaphorePermit,
) -> Response {
    let (parts, waiting) = mpsc::channel(1);
    tokio::spawn(follow(shown, parts, connection.last(), permit));
    let parts = unfold(waiting, async |mut waiting: mpsc::Receiver<Bytes>| {
        waiting.recv().await.map(|part| (Ok::<_, Infallible>(part), waiting))
    });
    let mut response = Response::new(Body::from_stream(parts));
    response.headers_mut().insert(CONTENT_TYPE, KIND);
    response
}

async fn follow(
    mut shown: watch::Receiver<Option<Shown>>,
    parts: mpsc::Sender<Bytes>,
    _lasting: Lasting,
    _permit: OwnedSemaphorePermit,
) {
    if parts.send(Bytes::from_static(BOUNDARY)).await.is_err() {
        return;
    }
    loop {
        tokio::select! {
            changed = shown.changed() => {
                if changed.is_err() {
                    return;
                }
            }
            () = parts.closed() => return,
        }
        let jpeg = shown.borrow_and_update().as_ref().and_then(|it| it.jpeg.clone());
        let Some(jpeg) = jpeg else { continue };
        if !matches!(timeout(SEND_TIMEOUT, parts.send(part(&jpeg))).await, Ok(Ok(()))) {
            return;
        }
    }
}

/// A picture and the boundary behind it, without which a viewer would show it only when the next comes.
fn part(jpeg: &[u8]) -> Bytes {
    let head = format!("Content-Type: image/jpeg\r\nContent-Length: {}\r\n\r\n", jpeg.len());
    [head.as_bytes(), jpeg, b"\r\n", BOUNDARY].concat().into()
}
