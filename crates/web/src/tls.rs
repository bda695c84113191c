//! Encrypts connections with a server's certificate and private key.

use std::io;
use std::path::Path;
use std::sync::Arc;

use anyhow::Context;
use rustls::ServerConfig;
use rustls::crypto::ring;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

/// The first byte of a TLS connection: a record of the type "handshake" (RFC 8446, 5.1). No HTTP request begins with it.
const HANDSHAKE: u8 = 22;

/// Encrypts connections, TLS 1.2 and 1.3.
#[derive(Clone)]
pub struct Tls(TlsAcceptor);

/// How a connection begins.
pub(crate) enum Begun {
    /// Encrypted.
    Encrypted(Box<TlsStream<TcpStream>>),
    /// With bytes other than TLS, or with none.
    Plain(TcpStream),
}

impl Tls {
    /// Reads a certificate, with those that sign it behind it, and its private key, each in PEM.
    ///
    /// # Errors
    /// When a file cannot be read, others may read the key, or they do not belong together.
    pub fn read(certificate: &Path, key: &Path) -> anyhow::Result<Self> {
        node::network::check_private(key)?;
        let chain = CertificateDer::pem_file_iter(certificate)
            .and_then(Iterator::collect::<Result<Vec<_>, _>>)
            .with_context(|| format!("reading the certificate {certificate:?} (PEM)"))?;
        let private = PrivateKeyDer::from_pem_file(key)
            .with_context(|| format!("reading the private key {key:?} (PEM)"))?;
        let mut config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()
            .and_then(|it| it.with_no_client_auth().with_single_cert(chain, private))
            .with_context(|| format!("the certificate {certificate:?} with the key {key:?}"))?;
        config.alpn_protocols = vec![b"http/1.1".to_vec()];
        Ok(Self(TlsAcceptor::from(Arc::new(config))))
    }

    /// Begins a connection by the first byte of its other side.
    pub(crate) async fn begin(&self, stream: TcpStream) -> io::Result<Begun> {
        let mut first = [0];
        stream.peek(&mut first).await?;
        if first != [HANDSHAKE] {
            return Ok(Begun::Plain(stream));
        }
        Ok(Begun::Encrypted(Box::new(self.0.accept(stream).await?)))
    }
}
