//! Whether the files of a key belong together.
//!
//! A process whose files do not would start, listen nowhere, and say nothing of it.

use std::path::Path;

use anyhow::Context;
use rustls::RootCertStore;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::sign::CertifiedKey;

/// Checks the certificate of an authority, a certificate and its private key.
///
/// # Errors
/// Names the file that is no certificate or no key, or the key that belongs to another certificate.
pub(crate) fn check(authority: &Path, certificate: &Path, key: &Path) -> anyhow::Result<()> {
    trusted(authority)?;
    let own = certificate_of(certificate)?;
    let private = private_of(key)?;
    let provider = rustls::crypto::ring::default_provider();
    CertifiedKey::from_der(vec![own], private, &provider).with_context(|| {
        format!(
            "{key:?} does not belong to {certificate:?}; copy both from one `alight keys issue`"
        )
    })?;
    Ok(())
}

/// The authority in whose certificates a process trusts.
pub(crate) fn trusted(authority: &Path) -> anyhow::Result<RootCertStore> {
    let mut roots = RootCertStore::empty();
    roots
        .add(certificate_of(authority)?)
        .with_context(|| format!("{authority:?} is no certificate of an authority"))?;
    Ok(roots)
}

/// The private key of a file.
pub(crate) fn private_of(path: &Path) -> anyhow::Result<PrivateKeyDer<'static>> {
    PrivateKeyDer::from_pem_file(path).with_context(|| {
        format!("{path:?} is no private key; copy it again from where it was made")
    })
}

/// The first certificate of a file.
pub(crate) fn certificate_of(path: &Path) -> anyhow::Result<CertificateDer<'static>> {
    CertificateDer::from_pem_file(path).with_context(|| {
        format!("{path:?} is no certificate; copy it again from where it was made")
    })
}

#[cfg(test)]
mod tests {
    use rcgen::{CertificateParams, KeyPair};

    use super::*;

    #[test]
    fn a_key_of_another_certificate_and_files_that_are_none_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        for name in ["own", "other"] {
            let key = KeyPair::generate().unwrap();
            let certificate = CertificateParams::new(vec![name.to_owned()]).unwrap();
            let certificate = certificate.self_signed(&key).unwrap();
            std::fs::write(path(&format!("{name}.pem")), certificate.pem()).unwrap();
            std::fs::write(path(&format!("{name}.key")), key.serialize_pem()).unwrap();
        }
        std::fs::write(path("garbage"), "garbage").unwrap();
        let problem = |names: [&str; 3]| {
            let [authority, certificate, key] = names.map(path);
            check(&authority, &certificate, &key).map_err(|problem| format!("{problem:#}"))
        };
        assert_eq!(problem(["other.pem", "own.pem", "own.key"]), Ok(()));
        for (names, named) in [
            (["garbage", "own.pem", "own.key"], "garbage\" is no certificate"),
            (["other.pem", "garbage", "own.key"], "garbage\" is no certificate"),
            (["other.pem", "own.pem", "garbage"], "garbage\" is no private key"),
            (["other.pem", "own.pem", "other.key"], "other.key\" does not belong to"),
        ] {
            let told = problem(names).unwrap_err();
            assert!(told.contains(named), "{told}");
        }
    }
}
