//! Parses the address of the camera's video for the ground station; another program serves the video.

use std::fmt;
use std::str::FromStr;

/// Maximum length of an address, in bytes: that of MAVLink's VIDEO_STREAM_INFORMATION with its closing zero.
const MAX_BYTES: usize = 159;

/// A video that another program serves.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Video {
    /// At an RTSP server, by its address.
    Rtsp(String),
    /// H.264 in RTP, sent to this UDP port of the ground station.
    RtpH264(u16),
    /// H.265 in RTP, sent to this UDP port of the ground station.
    RtpH265(u16),
}

impl Video {
    /// The address as VIDEO_STREAM_INFORMATION has it: of the server, or the ground station's port.
    pub(crate) fn uri(&self) -> String {
        match self {
            Self::Rtsp(address) => address.clone(),
            Self::RtpH264(port) | Self::RtpH265(port) => port.to_string(),
        }
    }
}

/// The error of a text that is no address of a video.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct NoVideo;

impl fmt::Display for NoVideo {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            to,
            "must be rtsp://HOST:PORT/PATH (at most {MAX_BYTES} characters), rtp-h264:PORT or rtp-h265:PORT"
        )
    }
}

impl std::error::Error for NoVideo {}

impl FromStr for Video {
    type Err = NoVideo;

    fn from_str(text: &str) -> Result<Self, NoVideo> {
        let port = |text: &str| text.parse().ok().filter(|port| *port > 0).ok_or(NoVideo);
        if let Some(at) = text.strip_prefix("rtsp://") {
            let is_one_word = text.chars().all(|it| it.is_ascii_graphic());
            let fits = !at.is_empty() && !at.starts_with('/') && text.len() <= MAX_BYTES;
            return (is_one_word && fits).then(|| Self::Rtsp(text.to_owned())).ok_or(NoVideo);
        }
        match text.split_once(':') {
            Some(("rtp-h264", at)) => port(at).map(Self::RtpH264),
            Some(("rtp-h265", at)) => port(at).map(Self::RtpH265),
            _ => Err(NoVideo),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_those_that_ground_stations_open() {
        let rtsp = "rtsp://10.0.0.2:8554/down";
        assert_eq!(rtsp.parse(), Ok(Video::Rtsp(rtsp.to_owned())));
        assert_eq!("rtp-h264:5600".parse(), Ok(Video::RtpH264(5600)));
        assert_eq!("rtp-h265:5601".parse::<Video>().unwrap().uri(), "5601");
        let long = format!("rtsp://{}", "a".repeat(MAX_BYTES));
        for wrong in ["", "rtsp://", "rtsp:///x", "rtsp://a b", "rtp-h264:0", "rtp-h264:x", "5600"]
            .into_iter()
            .chain([long.as_str()])
        {
            assert_eq!(wrong.parse::<Video>(), Err(NoVideo), "{wrong}");
        }
    }
}
