//! Cameras of Video4Linux, read without any other program: USB cameras, and sensors whose drivers convert themselves.
//!
//! Modules in reading order: `abi` is what crosses the border to the kernel and the trait of a device; `kernel` makes the
//! calls, the only file that does; `describe` lists what a device offers; `pixels` takes the grey levels
//! of a frame; `exposer` sets its exposure; `capture` reads frames; `video` goes on when the device is lost. All but `kernel`
//! runs in tests against a device that is played (`fake`).

pub(crate) mod abi;
pub(crate) mod capture;
pub(crate) mod describe;
pub(crate) mod exposer;
#[cfg(test)]
pub(crate) mod fake;
pub(crate) mod kernel;
pub(crate) mod pixels;
pub(crate) mod video;
