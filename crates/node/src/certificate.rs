//! What a certificate says: whose it is, until when, and by whom it is signed.

use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context, anyhow};
use x509_parser::pem::{Pem, parse_x509_pem};

/// A certificate, as far as it is of interest.
pub struct Certificate {
    /// The common name: the holder.
    pub common_name: String,
    /// Seconds until it ends; negative when it has.
    pub expires_in_s: i64,
}

/// Reads a certificate.
///
/// # Errors
/// When the file is not a certificate.
pub fn certificate(path: &Path) -> anyhow::Result<Certificate> {
    let pem = pem_of(path)?;
    let certificate =
        pem.parse_x509().map_err(|cause| anyhow!("{path:?} is not a certificate: {cause}"))?;
    let name = certificate.subject().iter_common_name().next();
    let common_name = name.and_then(|name| name.as_str().ok()).unwrap_or_default().to_owned();
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
    let expires_in_s = certificate.validity().not_after.timestamp() - now.cast_signed();
    Ok(Certificate { common_name, expires_in_s })
}

/// Whether an authority has signed a certificate.
///
/// # Errors
/// When a file is not a certificate.
pub fn is_signed_by(certificate: &Path, authority: &Path) -> anyhow::Result<bool> {
    let (signed, signer) = (pem_of(certificate)?, pem_of(authority)?);
    let (signed, signer) = (signed.parse_x509()?, signer.parse_x509()?);
    Ok(signed.verify_signature(Some(signer.public_key())).is_ok())
}

fn pem_of(path: &Path) -> anyhow::Result<Pem> {
    let text = std::fs::read(path).with_context(|| format!("reading the certificate {path:?}"))?;
    let (_, pem) =
        parse_x509_pem(&text).map_err(|cause| anyhow!("{path:?} is not a certificate: {cause}"))?;
    Ok(pem)
}
