//! The name of a process on the network.

/// Which service a process is, and which instance of it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    /// The service.
    pub service: &'static str,
    /// The instance: a name without slashes.
    pub instance: String,
}

impl std::fmt::Display for Identity {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} `{}`", self.service, self.instance)
    }
}
