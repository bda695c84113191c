//! Checks that the files of a key belong together.
//!
//! Otherwise a process would start and listen nowhere, without an error.

use std::io;
use std::path::Path;

use anyhow::{Context, anyhow, ensure};
use rustls::RootCertStore;
use rustls::pki_types::pem::{self, PemObject};
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

/// The authority that a process trusts.
pub(crate) fn trusted(authority: &Path) -> anyhow::Result<RootCertStore> {
    let mut roots = RootCertStore::empty();
    roots
        .add(certificate_of(authority)?)
        .with_context(|| format!("{authority:?} is no certificate of an authority"))?;
    Ok(roots)
}

/// The private key of a file.
pub(crate) fn private_of(path: &Path) -> anyhow::Result<PrivateKeyDer<'static>> {
    PrivateKeyDer::from_pem_file(path).map_err(|cause| unusable(path, "private key", cause))
}

/// The first certificate of a file.
pub(crate) fn certificate_of(path: &Path) -> anyhow::Result<CertificateDer<'static>> {
    CertificateDer::from_pem_file(path).map_err(|cause| unusable(path, "certificate", cause))
}

/// The error of a file that cannot be used as this kind of file.
fn unusable(path: &Path, kind: &str, cause: pem::Error) -> anyhow::Error {
    if let pem::Error::Io(cause) = &cause
        && let Err(denied) = check_permission(path, cause)
    {
        return denied;
    }
    anyhow!(cause).context(format!("{path:?} is no {kind}; copy it again from its origin"))
}

/// Checks that missing rights of this user are not the reason why a file of a key was not found or read: then the file is not faulty.
///
/// # Errors
/// Names the user that may read it.
pub(crate) fn check_permission(path: &Path, cause: &io::Error) -> anyhow::Result<()> {
    ensure!(
        cause.kind() != io::ErrorKind::PermissionDenied,
        "this user may not read {path:?}: run this as the user of the services (`sudo -u alight alight ...`), which should own the \
         keys (`sudo chown alight: FILE`), or with a key of your own (`--keys DIRECTORY`)"
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use rcgen::{CertificateParams, KeyPair};

    use super::*;

    #[test]
    fn a_key_of_another_certificate_and_invalid_files_are_named() {
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
            let problem = problem(names).unwrap_err();
            assert!(problem.contains(named), "{problem}");
        }
    }

    #[test]
    fn a_file_that_this_user_may_not_read_is_not_called_a_wrong_one() {
        let path = Path::new("keys/operator.key");
        let problem_of = |kind: io::ErrorKind| {
            format!("{:#}", unusable(path, "private key", pem::Error::Io(kind.into())))
        };
        let denied = problem_of(io::ErrorKind::PermissionDenied);
        assert!(denied.starts_with("this user may not read \"keys/operator.key\""), "{denied}");
        assert!(denied.contains("`sudo -u alight alight ...`"), "{denied}");
        let absent = problem_of(io::ErrorKind::NotFound);
        assert!(absent.starts_with("\"keys/operator.key\" is no private key"), "{absent}");
    }
}
