//! STag: a black square with a white disc in it, and 48 dots in the disc (Benligiray, Topal, Akinlar: "STag: A stable
//! fiducial marker system", Image and Vision Computing 89, 2019).

pub(crate) mod code;
