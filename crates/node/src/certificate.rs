//! Reads a certificate: its holder, validity period and authority.

use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context, anyhow};
use x509_parser::pem::{Pem, parse_x509_pem};

/// A certificate, as far as it is of interest.
pub struct Certificate {
    /// The common name: the holder.
    pub common_name: String,
    /// Seconds until it begins to be valid; negative when it has.
    pub begins_in_s: i64,
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
    let validity = certificate.validity();
    let [begins_in_s, expires_in_s] = [validity.not_before, validity.not_after]
        .map(|time| time.timestamp().saturating_sub(now.cast_signed()));
    Ok(Certificate { common_name, begins_in_s, expires_in_s })
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_validity_period_of_a_certificate_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.pem");
        let key = rcgen::KeyPair::generate().unwrap();
        let mut params = rcgen::CertificateParams::default();
        for (years, is_begun, is_over) in
            [((2001, 3000), true, false), ((2999, 3000), false, false), ((2001, 2002), true, true)]
        {
            params.not_before = rcgen::date_time_ymd(years.0, 1, 1);
            params.not_after = rcgen::date_time_ymd(years.1, 1, 1);
            std::fs::write(&path, params.self_signed(&key).unwrap().pem()).unwrap();
            let read = certificate(&path).unwrap();
            assert_eq!((read.begins_in_s < 0, read.expires_in_s < 0), (is_begun, is_over));
        }
    }
}
