//! Tests which certificates are served.

use std::fs::{Permissions, copy, set_permissions, write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use anyhow::ensure;
use web::Tls;

/// A certificate and its key in files of this name.
fn make(folder: &Path, name: &str) -> anyhow::Result<[PathBuf; 2]> {
    let [certificate, key] = ["pem", "key"].map(|it| folder.join(name).with_extension(it));
    let made = rcgen::generate_simple_self_signed(["localhost".to_owned()])?;
    write(&certificate, made.cert.pem())?;
    write(&key, made.signing_key.serialize_pem())?;
    set_permissions(&key, Permissions::from_mode(0o600))?;
    Ok([certificate, key])
}

#[test]
fn a_certificate_that_cannot_be_served_is_named() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let [certificate, key] = make(folder.path(), "page")?;
    let [_, other] = make(folder.path(), "other")?;
    let [absent, open] = ["absent.pem", "open.key"].map(|name| folder.path().join(name));
    copy(&key, &open)?;
    set_permissions(&open, Permissions::from_mode(0o644))?;
    Tls::read(&certificate, &key)?;
    for (certificate, key, named) in [
        (&certificate, &other, "with the key"),
        (&certificate, &open, "open to other users"),
        (&absent, &key, "absent.pem"),
        (&certificate, &absent, "absent.pem"),
        (&certificate, &certificate, "page.pem"),
        (&key, &key, "page.key"),
    ] {
        let problem = Tls::read(certificate, key).map(drop).map_err(|it| format!("{it:#}"));
        let is_named = problem.as_ref().is_err_and(|it| it.contains(named));
        ensure!(is_named, "{certificate:?} with {key:?}, {named}: {problem:?}");
    }
    Ok(())
}
