//! Chooses the cipher of encrypted links.

use rustls::crypto::CryptoProvider;
use rustls::crypto::ring::{cipher_suite, default_provider};

/// Makes ChaCha20-Poly1305 the default cipher, which Zenoh's connections take; only the first call in a process counts.
///
/// AES-GCM asks for other keys after 2^24 records (RFC 8446, section 5.5), ChaCha20-Poly1305 never, and while the keys of a connection change Zenoh
/// reads and writes it in two threads (`zenoh-config/README.md`).
pub(crate) fn choose() {
    let cipher_suites = vec![cipher_suite::TLS13_CHACHA20_POLY1305_SHA256];
    // Refused where it was called before.
    drop(CryptoProvider { cipher_suites, ..default_provider() }.install_default());
}
