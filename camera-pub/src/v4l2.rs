//! Reads cameras of Video4Linux without another program: USB cameras, and sensors whose drivers convert the frames.
//!
//! Modules in reading order: `abi` has the structures of the kernel's interface and the trait of a device. `kernel` is the
//! only file that makes system calls. `describe` lists a device's capabilities, `pixels` takes the grey levels of a frame,
//! `exposer` sets its exposure, `capture` reads frames, and `video` continues when the device is lost. Tests run all but
//! `kernel` against a simulated device (`fake`).

pub(crate) mod abi;
pub(crate) mod capture;
pub(crate) mod describe;
pub(crate) mod exposer;
#[cfg(test)]
pub(crate) mod fake;
pub(crate) mod kernel;
pub(crate) mod pixels;
pub(crate) mod video;
