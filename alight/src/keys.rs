//! `alight keys`: a development certificate authority, and a key for each role.
//!
//! The common name of a certificate is its role, to which `zenoh-config/secured.json5` grants access rights.
//! The development authority cannot revoke keys: they expire, and a site that lost a key makes a new
//! authority.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, anyhow, ensure};
use clap::{Args, Subcommand, ValueEnum};
use node::network::AUTHORITY;
use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
    KeyUsagePurpose,
};

/// The authority's private key, which is not copied to other machines.
const AUTHORITY_KEY: &str = "authority.key";
/// Certificates are valid a day early, as a drone's clock may be slow before it is synchronised.
const BACKDATING: Duration = DAY;
const DAY: Duration = Duration::from_secs(86_400);

/// The arguments of `alight keys`.
#[derive(Args, Clone)]
pub(crate) struct KeysArgs {
    #[command(subcommand)]
    action: Action,
}

#[derive(Clone, Subcommand)]
enum Action {
    /// Make a certificate authority: `authority.pem` for all machines, `authority.key` to be kept private.
    Init {
        /// Output directory.
        #[arg(short, long, value_name = "DIRECTORY")]
        output: PathBuf,
        /// Days until it expires.
        #[arg(long, value_name = "DAYS", default_value_t = 3650, value_parser = clap::value_parser!(u32).range(1..=36_500))]
        days: u32,
    },
    /// Make a key and its certificate: `ROLE.key` and `ROLE.pem`, with `authority.pem` beside them.
    Issue {
        /// Role of the holder, which has its access rights.
        #[arg(long, value_enum)]
        role: Role,
        /// Output directory.
        #[arg(short, long, value_name = "DIRECTORY")]
        output: PathBuf,
        /// Directory of the authority [default: the output directory].
        #[arg(long, value_name = "DIRECTORY")]
        authority: Option<PathBuf>,
        /// Address of the holder: an IP address or a host name. Required for `drone` and `relay`. May be
        /// repeated.
        #[arg(long, value_name = "HOST")]
        address: Vec<String>,
        /// Days until it expires.
        #[arg(long, value_name = "DAYS", default_value_t = 365, value_parser = clap::value_parser!(u32).range(1..=36_500))]
        days: u32,
    },
}

/// The role of a key.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Role {
    /// The drone's relay.
    Drone,
    /// A relay between drone and ground.
    Relay,
    /// An operator: `alight command`, `alight doctor`.
    Operator,
    /// Subscribes only.
    Observer,
    /// Publishes frames.
    CameraPub,
    /// Publishes detections.
    Detector,
    /// Publishes the vehicle's state, and receives commands.
    Controller,
    /// Forwards MAVLink between the autopilot and the ground station.
    GcsBridge,
    /// Simulates camera and vehicle.
    Simulator,
}

impl Role {
    /// The common name.
    fn name(self) -> String {
        self.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
    }

    /// Others connect to it from outside.
    fn is_found_by_others(self) -> bool {
        matches!(self, Self::Drone | Self::Relay)
    }
}

/// A certificate, as far as it is of interest.
pub(crate) struct Certificate {
    /// The common name.
    pub(crate) role: String,
    /// Seconds until it ends; negative when it has.
    pub(crate) expires_in_s: i64,
}

/// Makes an authority or a key.
pub(crate) fn run(args: &KeysArgs) -> anyhow::Result<ExitCode> {
    let written = match &args.action {
        Action::Init { output, days } => init(output, *days)?,
        Action::Issue { role, output, authority, address, days } => {
            issue(*role, output, authority.as_deref().unwrap_or(output), address, *days)?
        }
    };
    let mut out = std::io::stdout().lock();
    for path in written {
        writeln!(out, "{}", path.display())?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Reads a certificate.
pub(crate) fn certificate(path: &Path) -> anyhow::Result<Certificate> {
    let text = fs::read(path).with_context(|| format!("reading the certificate {path:?}"))?;
    let (_, pem) = x509_parser::pem::parse_x509_pem(&text)
        .map_err(|cause| anyhow!("{path:?} is not a certificate: {cause}"))?;
    let certificate =
        pem.parse_x509().map_err(|cause| anyhow!("{path:?} is not a certificate: {cause}"))?;
    let role = certificate.subject().iter_common_name().next();
    let role = role.and_then(|name| name.as_str().ok()).unwrap_or_default().to_owned();
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
    let expires_in_s = certificate.validity().not_after.timestamp() - now.cast_signed();
    Ok(Certificate { role, expires_in_s })
}

fn init(output: &Path, days: u32) -> anyhow::Result<Vec<PathBuf>> {
    let files = [output.join(AUTHORITY_KEY), output.join(AUTHORITY)];
    refuse_existing(&files)?;
    let mut params = parameters("Alight development authority", &[], days)?;
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    let key = KeyPair::generate().context("making the authority's key")?;
    let certificate = params.self_signed(&key).context("signing the authority's certificate")?;
    make_directory(output)?;
    write_new(&files[0], &key.serialize_pem())?;
    write_new(&files[1], &certificate.pem())?;
    Ok(files.into())
}

fn issue(
    role: Role,
    output: &Path,
    authority: &Path,
    addresses: &[String],
    days: u32,
) -> anyhow::Result<Vec<PathBuf>> {
    let name = role.name();
    ensure!(
        !role.is_found_by_others() || !addresses.is_empty(),
        "the key of `{name}` needs the address to which others connect: add `--address HOST`"
    );
    let files = [output.join(format!("{name}.key")), output.join(format!("{name}.pem"))];
    refuse_existing(&files)?;
    let read = |file: &str| {
        let path = authority.join(file);
        fs::read_to_string(&path).with_context(|| {
            format!(
                "reading {path:?}; make an authority with `alight keys init -o {}`",
                authority.display()
            )
        })
    };
    let authority_certificate = read(AUTHORITY)?;
    let signing_key = KeyPair::from_pem(&read(AUTHORITY_KEY)?)
        .with_context(|| format!("{:?} is not a key", authority.join(AUTHORITY_KEY)))?;
    let issuer =
        Issuer::from_ca_cert_pem(&authority_certificate, signing_key).with_context(|| {
            format!("{:?} is not the certificate of an authority", authority.join(AUTHORITY))
        })?;
    // Processes on one machine also connect to each other.
    let mut names = addresses.to_vec();
    for here in ["127.0.0.1", "localhost"] {
        if !names.iter().any(|name| name == here) {
            names.push(here.to_owned());
        }
    }
    let mut params = parameters(&name, &names, days)?;
    params.use_authority_key_identifier_extension = true;
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    params.extended_key_usages =
        vec![ExtendedKeyUsagePurpose::ClientAuth, ExtendedKeyUsagePurpose::ServerAuth];
    let key = KeyPair::generate().context("making the key")?;
    let certificate = params.signed_by(&key, &issuer).context("signing the certificate")?;
    make_directory(output)?;
    put_authority(&output.join(AUTHORITY), &authority_certificate)?;
    write_new(&files[0], &key.serialize_pem())?;
    write_new(&files[1], &certificate.pem())?;
    Ok(files.into())
}

fn parameters(name: &str, addresses: &[String], days: u32) -> anyhow::Result<CertificateParams> {
    let mut params = CertificateParams::new(addresses.to_vec())
        .with_context(|| format!("invalid addresses {addresses:?}"))?;
    params.distinguished_name = rcgen::DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, name);
    let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let now = rcgen::date_time_ymd(1970, 1, 1) + Duration::from_secs(since_1970.as_secs());
    params.not_before = now - BACKDATING;
    params.not_after = now + DAY * days;
    Ok(params)
}

/// Writes the authority's certificate beside the keys, unless it is there.
fn put_authority(path: &Path, certificate: &str) -> anyhow::Result<()> {
    match fs::read_to_string(path) {
        Ok(there) => {
            ensure!(
                there == certificate,
                "{path:?} is of another authority; use one directory for each authority"
            );
            Ok(())
        }
        Err(_) => write_new(path, certificate),
    }
}

fn refuse_existing(files: &[PathBuf]) -> anyhow::Result<()> {
    for file in files {
        ensure!(
            !file.exists(),
            "{file:?} exists, and keys are never overwritten; remove it, or choose another directory"
        );
    }
    Ok(())
}

fn make_directory(path: &Path) -> anyhow::Result<()> {
    fs::DirBuilder::new()
        .recursive(true)
        .mode(0o700)
        .create(path)
        .with_context(|| format!("making the directory {path:?}"))
}

fn write_new(path: &Path, text: &str) -> anyhow::Result<()> {
    let mut file = OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(path)
        .with_context(|| format!("making {path:?}"))?;
    file.write_all(text.as_bytes()).with_context(|| format!("writing {path:?}"))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn a_key_has_a_role_expires_and_is_private() {
        let home = tempfile::tempdir().unwrap();
        let drone = home.path().join("drone");
        init(home.path(), 30).unwrap();
        let files = issue(Role::Drone, &drone, home.path(), &["10.0.0.1".into()], 7).unwrap();
        let read = certificate(&files[1]).unwrap();
        assert_eq!(read.role, "drone");
        assert!((read.expires_in_s - 7 * 86_400).abs() < 120, "{} s", read.expires_in_s);
        for file in files.iter().chain([&drone.join(AUTHORITY)]) {
            let mode = fs::metadata(file).unwrap().permissions().mode();
            assert_eq!(mode & 0o777, 0o600, "{file:?}");
        }
        assert!(!drone.join(AUTHORITY_KEY).exists(), "the authority's key is not copied");
    }

    #[test]
    fn keys_are_not_overwritten_and_authorities_are_not_mixed() {
        let home = tempfile::tempdir().unwrap();
        let other = tempfile::tempdir().unwrap();
        init(home.path(), 30).unwrap();
        init(other.path(), 30).unwrap();
        let refused = |result: anyhow::Result<Vec<PathBuf>>, part: &str| {
            let problem = format!("{:#}", result.unwrap_err());
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        };
        refused(init(home.path(), 30), "never overwritten");
        let here = home.path();
        issue(Role::Detector, here, here, &[], 30).unwrap();
        refused(issue(Role::Detector, here, here, &[], 30), "never overwritten");
        refused(issue(Role::Operator, here, other.path(), &[], 30), "another authority");
        refused(issue(Role::Relay, here, here, &[], 30), "--address HOST");
        refused(issue(Role::Operator, here, &here.join("none"), &[], 30), "alight keys init");
    }
}
