//! Serves the pictures of one camera as Motion JPEG: JPEG files one after the other in an HTTP response without end
//! (multipart/x-mixed-replace).

use std::convert::Infallible;
use std::time::Duration;

use airlink::picture::jpeg;
use axum::body::{Body, Bytes};
use axum::http::HeaderValue;
use axum::http::header::CONTENT_TYPE;
use axum::response::Response;
use futures_util::stream::unfold;
use messages::{FrameHeader, PixelFormat};
use node::Node;
use tokio::sync::{OwnedSemaphorePermit, mpsc, watch};
use tokio::time::{sleep, timeout};
use web::{Connection, Lasting};

use crate::canvas::Canvas;
use crate::video::{LOOK_PERIOD, Pictures};

const KIND: HeaderValue = HeaderValue::from_static("multipart/x-mixed-replace; boundary=picture");
const BOUNDARY: &[u8] = b"--picture\r\n";
/// A client that takes no picture within this time is disconnected.
const SEND_TIMEOUT: Duration = Duration::from_secs(5);

/// Makes each picture one file, while there is a viewer.
pub(crate) async fn run(node: Node, pictures: Pictures, quality: u8) -> anyhow::Result<()> {
    let Pictures { shown, files, .. } = pictures;
    loop {
        while files.receiver_count() == 0 {
            sleep(LOOK_PERIOD).await;
        }
        let mut painter = Painter::default();
        let mut shown = shown.subscribe();
        while files.receiver_count() > 0 {
            // The number of viewers is checked also while no picture arrives.
            let Ok(Ok(())) = timeout(LOOK_PERIOD, shown.changed()).await else { continue };
            let Some(picture) = shown.borrow_and_update().clone() else { continue };
            let paint = move || {
                let file = painter.file(&picture.header, picture.files, quality);
                (painter, file)
            };
            let file;
            (painter, file) = tokio::task::spawn_blocking(paint).await?;
            match file {
                Ok(file) => {
                    files.send_replace(Some(file));
                }
                Err(error) => {
                    if node.health().failed("no complete picture of a frame") {
                        tracing::warn!(error, "A frame cannot be shown as Motion JPEG");
                    }
                }
            }
        }
        files.send_replace(None);
    }
}

/// Makes one picture of the parts of frames.
#[derive(Default)]
struct Painter {
    canvas: Canvas,
    camera: String,
}

impl Painter {
    /// The picture after a frame; areas outside its parts keep the previous content.
    fn file(&mut self, header: &FrameHeader, files: Bytes, quality: u8) -> Result<Bytes, String> {
        if header.parts.is_empty() {
            return Ok(files);
        }
        if self.camera != header.camera {
            self.camera.clone_from(&header.camera);
            self.canvas = Canvas::default();
        }
        let image = self.canvas.draw(header, &files)?;
        if is_one_file(header) {
            return Ok(files);
        }
        let header = FrameHeader {
            width: image.width() as u32,
            height: image.height() as u32,
            format: PixelFormat::Mono8,
            parts: Vec::new(),
            ..header.clone()
        };
        jpeg(&header, image.pixels(), quality).map(Bytes::from).ok_or_else(|| {
            format!("{} x {} pixels cannot be a JPEG picture", header.width, header.height)
        })
    }
}

/// Whether one file shows the full frame.
fn is_one_file(header: &FrameHeader) -> bool {
    match header.parts.as_slice() {
        [] => true,
        [part] => {
            let shown = [part.width, part.height].map(|edge| edge.saturating_mul(part.scale));
            [part.x, part.y] == [0, 0] && shown[0] >= header.width && shown[1] >= header.height
        }
        _ => false,
    }
}

/// The response with the pictures until `end`, the newest one whenever the previous one was taken.
pub(crate) fn answer(
    pictures: watch::Receiver<Option<Bytes>>,
    connection: Connection,
    end: impl Future<Output = ()> + Send + 'static,
    permit: OwnedSemaphorePermit,
) -> Response {
    let (parts, waiting) = mpsc::channel(1);
    let following = follow(pictures, parts, connection.last(), permit);
    tokio::spawn(async move {
        tokio::select! {
            () = following => {}
            () = end => {}
        }
    });
    let parts = unfold(waiting, async |mut waiting: mpsc::Receiver<Bytes>| {
        waiting.recv().await.map(|part| (Ok::<_, Infallible>(part), waiting))
    });
    let mut response = Response::new(Body::from_stream(parts));
    response.headers_mut().insert(CONTENT_TYPE, KIND);
    response
}

async fn follow(
    mut pictures: watch::Receiver<Option<Bytes>>,
    parts: mpsc::Sender<Bytes>,
    _lasting: Lasting,
    _permit: OwnedSemaphorePermit,
) {
    if parts.send(Bytes::from_static(BOUNDARY)).await.is_err() {
        return;
    }
    loop {
        tokio::select! {
            changed = pictures.changed() => {
                if changed.is_err() {
                    return;
                }
            }
            () = parts.closed() => return,
        }
        let jpeg = pictures.borrow_and_update().clone();
        let Some(jpeg) = jpeg else { continue };
        if !matches!(timeout(SEND_TIMEOUT, parts.send(part(&jpeg))).await, Ok(Ok(()))) {
            return;
        }
    }
}

/// A picture and the boundary after it, without which a viewer would show it only when the next one arrives.
fn part(jpeg: &[u8]) -> Bytes {
    let head = format!("Content-Type: image/jpeg\r\nContent-Length: {}\r\n\r\n", jpeg.len());
    [head.as_bytes(), jpeg, b"\r\n", BOUNDARY].concat().into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::FramePart;

    const PART: FramePart = FramePart { x: 0, y: 0, width: 64, height: 48, scale: 1, bytes: 0 };

    /// A frame of 64 x 48 pixels in parts of one grey each.
    fn frame(parts: &[(FramePart, u8)]) -> (FrameHeader, Bytes) {
        let (width, height) = (64, 48);
        let mut header = FrameHeader { width, height, ..FrameHeader::sample() };
        let mut files = Vec::new();
        for (part, grey) in parts {
            let (width, height) = (part.width, part.height);
            let plain = FrameHeader {
                width,
                height,
                format: PixelFormat::Mono8,
                parts: Vec::new(),
                ..header.clone()
            };
            let file = jpeg(&plain, &vec![*grey; (width * height) as usize], 90).unwrap();
            header.parts.push(FramePart { bytes: file.len() as u32, ..*part });
            files.extend(file);
        }
        header.format = PixelFormat::Jpeg;
        (header, files.into())
    }

    #[test]
    fn a_frame_in_parts_is_one_picture_over_the_previous_one() {
        let mut painter = Painter::default();
        let (header, file) = frame(&[(PART, 200)]);
        assert_eq!(painter.file(&header, file.clone(), 90).unwrap(), file, "unchanged");
        let region = FramePart { x: 16, y: 16, width: 16, height: 16, ..PART };
        let (header, files) = frame(&[(region, 20)]);
        let picture = painter.file(&header, files, 90).unwrap();
        let full = FramePart { bytes: picture.len() as u32, ..PART };
        let mut canvas = Canvas::default();
        let image =
            canvas.draw(&FrameHeader { parts: vec![full], ..header }, &picture).unwrap().clone();
        assert_eq!((image.width(), image.height()), (64, 48));
        let grey = |x: usize, y: usize| image.row(y)[x];
        assert!(grey(4, 4) > 190 && grey(24, 24) < 30 && grey(60, 40) > 190);
        let (header, files) = frame(&[(PART, 20)]);
        assert!(painter.file(&header, files.slice(..files.len() / 2), 90).is_err());
    }
}
