//! `alight keys`: makes a development certificate authority, issues and revokes a certificate and private key for each role,
//! keeps the list of holders, and makes passphrases for signed MAVLink packets.
//!
//! The common name of a certificate is its role with its vehicle, and of a detector its name
//! (`crates/node/src/access.rs`); `zenoh-config/secured.json5` has the rights of each role. The list of holders next to the authority's key
//! names the holders that may connect; a revoked holder stays refused.

use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions, Permissions};
use std::io::{self, Write};
use std::net::IpAddr;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt, fchown};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::{Context, ensure};
use clap::{Args, Subcommand, ValueEnum};
use node::access::{HOLDERS, Holder, Holders, key_name};
use node::certificate::{Certificate, certificate};
use node::network::{AUTHORITY, check_private};
use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
    KeyUsagePurpose,
};
use serde::Serialize;
use sha2::{Digest, Sha256};

use crate::args::{Format, WrongUse};
use crate::terminal::{aligned, print};

/// The authority's private key, which is not copied to other machines.
const AUTHORITY_KEY: &str = "authority.key";
/// Certificates are valid a day early, as a drone's clock may be slow before it is synchronised.
const BACKDATING: Duration = DAY;
/// The mode of a new list of holders, which is no secret.
const LIST_MODE: u32 = 0o644;
/// The letters and digits of a passphrase: 32 that are not mistaken for each other.
const LETTERS: &[u8; 32] = b"abcdefghijkmnpqrstuvwxyz23456789";
/// Number of letters of a passphrase.
const PASSPHRASE_LETTERS: usize = 25;
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
    /// Make a key and its certificate: `ROLE.key` and `ROLE.pem`, of a detector `detector.NAME`; with `authority.pem`
    /// and the list of holders, `holders.txt`, next to them.
    Issue {
        /// Role of the holder, which has its access rights.
        #[arg(long, value_enum)]
        role: Role,
        /// Name of the holder, to revoke its key alone; of a detector its id, the only one it may publish as
        /// [default for a detector: main].
        #[arg(long, value_name = "NAME")]
        name: Option<String>,
        /// The vehicle's name; other vehicles refuse the key.
        #[arg(long, value_name = "NAME", default_value = "drone")]
        vehicle: String,
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
    /// List the holders that may connect, by the list in a directory (the authority's, or its copy on any machine), and the keys
    /// that are there.
    List {
        /// The directory.
        #[arg(value_name = "DIRECTORY")]
        directory: PathBuf,
        /// Format of the list: a table, or one JSON object.
        #[arg(long, value_enum, default_value_t)]
        format: Format,
    },
    /// Make a passphrase for signed MAVLink packets: the file for `signing_key`, whose text goes into the autopilot or the
    /// ground station as well (docs/deploy.md).
    Signing {
        /// Output file.
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
    },
    /// Revoke the key of a holder permanently: copy the list of holders that this writes to the keys of every relay
    /// (`alight up drone`, `alight up relay`), which take it up within a second.
    Revoke {
        /// The holder as the list names it: ROLE@VEHICLE or ROLE.NAME@VEHICLE.
        #[arg(value_name = "HOLDER")]
        holder: Holder,
        /// Directory of the authority.
        #[arg(long, value_name = "DIRECTORY")]
        authority: PathBuf,
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
    /// Subscribes, and publishes its recorded messages.
    Recorder,
    /// Shows a landing in browsers, and commands as its configuration allows.
    Dashboard,
    /// Simulates camera and vehicle.
    Simulator,
}

/// The name of a key's files from the command line's argument: ROLE, or `detector.NAME`.
pub(crate) fn key_name_of(text: &str) -> Result<String, String> {
    let (role, name) = text.split_once('.').map_or((text, None), |(role, name)| (role, Some(name)));
    let is_role = Role::from_str(role, false).is_ok() && (role == "detector") == name.is_some();
    if !is_role || name.is_some_and(|name| !node::config::is_name(name)) {
        let others = Role::value_variants().iter().filter(|role| **role != Role::Detector);
        let others: Vec<_> = others.map(|role| role.name()).collect();
        return Err(format!("write `detector.NAME`, or one of {}", others.join(", ")));
    }
    Ok(key_name(role, name.unwrap_or_default()))
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

/// The holders that may connect, by name.
#[derive(Debug, Serialize)]
struct HolderList {
    holders: Vec<Listed>,
}

/// A holder in the list.
#[derive(Debug, Serialize)]
struct Listed {
    /// `operator.anna@drone`.
    holder: String,
    standing: Standing,
    /// The file of the holder's certificate in this directory.
    file: Option<String>,
    /// Days until the certificate expires; negative when it has.
    expires_in_days: Option<i64>,
    /// By this machine's clock the certificate is not valid yet.
    is_not_valid_yet: bool,
}

/// The state of a holder in the list.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Standing {
    Admitted,
    Revoked,
    /// A certificate is here, and the list does not name its holder.
    Unlisted,
}

impl Listed {
    fn without_key(holder: String, standing: Standing) -> Self {
        Self { holder, standing, file: None, expires_in_days: None, is_not_valid_yet: false }
    }
}

impl HolderList {
    fn table(&self) -> String {
        let mut rows = vec![["HOLDER", "MAY CONNECT", "KEY HERE"].map(str::to_owned)];
        for listed in &self.holders {
            let standing = match listed.standing {
                Standing::Admitted => "yes",
                Standing::Revoked => "no, revoked",
                Standing::Unlisted => "no, not in holders.txt",
            };
            let key = match (&listed.file, listed.expires_in_days) {
                (Some(file), Some(_)) if listed.is_not_valid_yet => {
                    format!("{file}, not valid yet: is this machine's clock right?")
                }
                (Some(file), Some(..0)) => format!("{file}, expired"),
                (Some(file), Some(days)) => format!("{file}, expires in {days} days"),
                _ => "-".to_owned(),
            };
            rows.push([listed.holder.clone(), standing.to_owned(), key]);
        }
        aligned(&rows).trim_end().to_owned()
    }
}

/// Makes an authority or a key, or lists those that there are.
pub(crate) fn run(args: &KeysArgs) -> anyhow::Result<ExitCode> {
    let written = match &args.action {
        Action::Init { output, days } => init(output, *days)?,
        Action::Issue { role, name, vehicle, output, authority, address, days } => {
            let default = (*role == Role::Detector).then_some("main");
            let holder = Holder::new(&role.name(), name.as_deref().or(default), vehicle)
                .map_err(|problem| WrongUse::of(&problem))?;
            let authority = authority.as_deref().unwrap_or(output);
            issue(*role, &holder, output, authority, address, *days)?
        }
        Action::List { directory, format } => {
            let list = list(directory)?;
            print(&match format {
                Format::Text => list.table(),
                Format::Json => serde_json::to_string(&list)?,
            })?;
            return Ok(ExitCode::SUCCESS);
        }
        Action::Signing { output } => vec![passphrase(output)?],
        Action::Revoke { holder, authority } => vec![revoke(holder, authority)?],
    };
    for path in written {
        print(&path.display().to_string())?;
    }
    Ok(ExitCode::SUCCESS)
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

/// Makes a certificate that signs itself, for a page at these addresses, and its private key. The result is the certificate's
/// SHA-256 as browsers show it.
pub(crate) fn self_signed(
    [certificate, key]: [&Path; 2],
    addresses: &[String],
    days: u32,
) -> anyhow::Result<String> {
    refuse_existing(&[certificate.to_owned(), key.to_owned()])?;
    let mut params = parameters("Alight dashboard", addresses, days)?;
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
    let pair = KeyPair::generate().context("making the page's key")?;
    let signed = params.self_signed(&pair).context("signing the page's certificate")?;
    for folder in [certificate, key].iter().filter_map(|path| path.parent()) {
        if !folder.as_os_str().is_empty() {
            make_directory(folder)?;
        }
    }
    write_new(key, &pair.serialize_pem())?;
    write_new(certificate, &signed.pem())?;
    let digest: Vec<_> =
        Sha256::digest(signed.der()).iter().map(|byte| format!("{byte:02X}")).collect();
    Ok(digest.join(":"))
}

/// Writes a passphrase of 125 bits, in groups that a person can copy.
fn passphrase(output: &Path) -> anyhow::Result<PathBuf> {
    refuse_existing(&[output.to_owned()])?;
    let mut random = [0; PASSPHRASE_LETTERS];
    getrandom::fill(&mut random).context("asking the system for random bytes")?;
    let letters: Vec<u8> =
        random.iter().filter_map(|byte| LETTERS.get(usize::from(byte % 32)).copied()).collect();
    let groups: Vec<_> = letters.chunks(5).map(String::from_utf8_lossy).collect();
    if let Some(directory) = output.parent().filter(|it| !it.as_os_str().is_empty()) {
        make_directory(directory)?;
    }
    write_new(output, &format!("{}\n", groups.join("-")))?;
    Ok(output.to_owned())
}

fn issue(
    role: Role,
    holder: &Holder,
    output: &Path,
    authority: &Path,
    addresses: &[String],
    days: u32,
) -> anyhow::Result<Vec<PathBuf>> {
    let name = holder.key_name();
    ensure!(
        !role.is_found_by_others() || !addresses.is_empty(),
        WrongUse(format!(
            "the key of `{name}` needs the address to which others connect: add `--address HOST`"
        ))
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
    check_private(&authority.join(AUTHORITY_KEY))?;
    let mut holders = read_holders(authority)?;
    holders.admit(holder)?;
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
    let mut params = parameters(&holder.to_string(), &names, days)?;
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
    write_holders(authority, &holders)?;
    if output != authority {
        write_holders(output, &holders)?;
    }
    Ok(files.into())
}

/// Revokes a holder; returns the list, which is to be copied to the relays.
fn revoke(holder: &Holder, authority: &Path) -> anyhow::Result<PathBuf> {
    let mut holders = read_holders(authority)?;
    holders.revoke(holder)?;
    write_holders(authority, &holders)
}

/// The holders that the list in a directory names, and those whose certificates are there.
fn list(directory: &Path) -> anyhow::Result<HolderList> {
    let path = directory.join(HOLDERS);
    let text = fs::read_to_string(&path).with_context(|| {
        format!("reading {path:?}, the list of holders, which `alight keys issue` writes")
    })?;
    let holders: Holders = text.parse().with_context(|| format!("{path:?}"))?;
    let mut by_name: BTreeMap<String, Listed> = BTreeMap::new();
    for (listed, standing) in holders
        .admitted()
        .map(|holder| (holder, Standing::Admitted))
        .chain(holders.revoked().map(|holder| (holder, Standing::Revoked)))
    {
        let holder = listed.to_string();
        by_name.insert(holder.clone(), Listed::without_key(holder, standing));
    }
    let files = fs::read_dir(directory).with_context(|| format!("reading {directory:?}"))?;
    let mut paths: Vec<PathBuf> = files.map(|file| Ok(file?.path())).collect::<io::Result<_>>()?;
    paths.retain(|path| {
        path.extension().is_some_and(|it| it == "pem") && !path.ends_with(AUTHORITY)
    });
    paths.sort();
    for path in paths {
        // Certificates of pages and others may be there as well.
        let Ok(Certificate { common_name, begins_in_s, expires_in_s }) = certificate(&path) else {
            continue;
        };
        if common_name.parse::<Holder>().is_err() {
            continue;
        }
        let listed = by_name
            .entry(common_name.clone())
            .or_insert_with(|| Listed::without_key(common_name, Standing::Unlisted));
        listed.file = path.file_name().map(|name| name.to_string_lossy().into_owned());
        listed.expires_in_days = Some(expires_in_s.div_euclid(DAY.as_secs().cast_signed()));
        listed.is_not_valid_yet = begins_in_s > 0;
    }
    Ok(HolderList { holders: by_name.into_values().collect() })
}

/// The holders of an authority's keys; none before the first.
fn read_holders(authority: &Path) -> anyhow::Result<Holders> {
    let path = authority.join(HOLDERS);
    match fs::read_to_string(&path) {
        Ok(text) => text.parse().with_context(|| format!("{path:?}")),
        Err(cause) if cause.kind() == io::ErrorKind::NotFound => Ok(Holders::default()),
        Err(cause) => Err(cause).with_context(|| format!("reading {path:?}")),
    }
}

/// Replaces the list in a directory atomically: a relay never reads half of it.
fn write_holders(directory: &Path, holders: &Holders) -> anyhow::Result<PathBuf> {
    let path = directory.join(HOLDERS);
    let written = tempfile::NamedTempFile::new_in(directory).and_then(|mut file| {
        file.write_all(holders.to_string().as_bytes())?;
        keep_access(file.as_file(), &path)?;
        file.persist(&path).map_err(|failed| failed.error)
    });
    written.with_context(|| format!("writing {path:?}"))?;
    Ok(path)
}

/// Gives a new list owner and mode of the one that it replaces: a relay that may not read it continues with the old one.
fn keep_access(file: &File, replaced: &Path) -> io::Result<()> {
    let mode = match fs::metadata(replaced) {
        Ok(before) => {
            // A user without the right to change the owner leaves it readable for the owner.
            let is_kept = fchown(file, Some(before.uid()), Some(before.gid())).is_ok();
            before.permissions().mode() & 0o777 | if is_kept { 0 } else { LIST_MODE }
        }
        Err(_) => LIST_MODE,
    };
    file.set_permissions(Permissions::from_mode(mode))
}

/// The keys of all roles in one directory, with those of these detectors.
#[cfg(test)]
pub(crate) fn make_for_tests(directory: &Path, detectors: &[&str]) -> anyhow::Result<()> {
    init(directory, 60)?;
    let make = |role: Role, name: Option<&str>| {
        let holder = Holder::new(&role.name(), name, "drone")?;
        issue(role, &holder, directory, directory, &["127.0.0.1".into()], 60).map(drop)
    };
    for role in Role::value_variants().iter().filter(|role| **role != Role::Detector) {
        make(*role, None)?;
    }
    detectors.iter().try_for_each(|name| make(Role::Detector, Some(name)))
}

/// Whether it is an IP address or a host name.
fn is_host(address: &str) -> bool {
    let is_name_of = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    address.parse::<IpAddr>().is_ok() || !address.is_empty() && address.chars().all(is_name_of)
}

fn parameters(name: &str, addresses: &[String], days: u32) -> anyhow::Result<CertificateParams> {
    for address in addresses {
        ensure!(
            is_host(address),
            WrongUse(format!(
                "invalid address `{address}`: expected an IP address or a host name, without a port"
            ))
        );
    }
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

/// Writes the authority's certificate next to the keys, unless it is there.
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
    use super::*;

    fn issue_for(
        role: Role,
        name: Option<&str>,
        output: &Path,
        authority: &Path,
    ) -> anyhow::Result<Vec<PathBuf>> {
        let holder = Holder::new(&role.name(), name, "drone")?;
        let addresses: &[String] = if role == Role::Drone { &["10.0.0.1".into()] } else { &[] };
        issue(role, &holder, output, authority, addresses, 7)
    }

    #[test]
    fn a_key_has_a_role_expires_and_is_private() {
        let home = tempfile::tempdir().unwrap();
        let drone = home.path().join("drone");
        init(home.path(), 30).unwrap();
        let files = issue_for(Role::Drone, None, &drone, home.path()).unwrap();
        let read = certificate(&files[1]).unwrap();
        assert_eq!(read.common_name, "drone@drone");
        assert!((read.expires_in_s - 7 * 86_400).abs() < 120, "{} s", read.expires_in_s);
        for file in files.iter().chain([&drone.join(AUTHORITY)]) {
            let mode = fs::metadata(file).unwrap().permissions().mode();
            assert_eq!(mode & 0o777, 0o600, "{file:?}");
        }
        assert!(!drone.join(AUTHORITY_KEY).exists(), "the authority's key is not copied");
    }

    fn refused<T: std::fmt::Debug>(result: anyhow::Result<T>, part: &str) {
        let problem = format!("{:#}", result.unwrap_err());
        assert!(problem.contains(part), "`{part}` is not in: {problem}");
    }

    #[test]
    fn keys_are_not_overwritten_and_authorities_are_not_mixed() {
        let home = tempfile::tempdir().unwrap();
        let other = tempfile::tempdir().unwrap();
        init(home.path(), 30).unwrap();
        init(other.path(), 30).unwrap();
        refused(init(home.path(), 30), "never overwritten");
        let here = home.path();
        issue_for(Role::Detector, Some("ground"), here, here).unwrap();
        refused(issue_for(Role::Detector, Some("ground"), here, here), "never overwritten");
        issue_for(Role::Detector, Some("spare"), here, here).unwrap();
        refused(issue_for(Role::Detector, None, here, here), "--name ID");
        refused(issue_for(Role::Operator, None, here, other.path()), "another authority");
        refused(issue_for(Role::Relay, None, here, here), "--address HOST");
        refused(issue_for(Role::Operator, None, here, &here.join("none")), "alight keys init");
        let key = here.join(AUTHORITY_KEY);
        fs::set_permissions(&key, Permissions::from_mode(0o644)).unwrap();
        refused(issue_for(Role::Observer, None, here, here), "chmod 600");
    }

    #[test]
    fn a_passphrase_is_random_private_and_a_key() {
        let home = tempfile::tempdir().unwrap();
        let files = ["a.key", "further/b.key"].map(|name| home.path().join(name));
        for file in &files {
            passphrase(file).unwrap();
            assert_eq!(fs::metadata(file).unwrap().permissions().mode() & 0o777, 0o600);
        }
        let texts = files.each_ref().map(|file| fs::read_to_string(file).unwrap());
        assert_ne!(texts[0], texts[1]);
        let groups: Vec<_> = texts[0].trim().split('-').map(str::len).collect();
        assert_eq!(groups, [5; 5], "{}", texts[0]);
        refused(passphrase(&files[0]), "never overwritten");
    }

    #[test]
    fn the_certificate_of_a_page_has_its_names_and_a_private_key() {
        let home = tempfile::tempdir().unwrap();
        let files = ["further/page.pem", "further/page.key"].map(|name| home.path().join(name));
        let make = |address: &str| {
            self_signed([&files[0], &files[1]], &[address.to_owned(), "kestrel.local".into()], 30)
        };
        let fingerprint = make("10.0.0.1").unwrap();
        assert_eq!(fingerprint.split(':').count(), 32, "{fingerprint}");
        assert_eq!(fs::metadata(&files[1]).unwrap().permissions().mode() & 0o777, 0o600);
        assert!((certificate(&files[0]).unwrap().expires_in_s - 30 * 86_400).abs() < 120);
        let text = fs::read(&files[0]).unwrap();
        let (_, pem) = x509_parser::pem::parse_x509_pem(&text).unwrap();
        let parsed = pem.parse_x509().unwrap();
        let names = &parsed.subject_alternative_name().unwrap().unwrap().value.general_names;
        let names = format!("{names:?}");
        assert!(names.contains("kestrel.local"), "{names}");
        refused(make("10.0.0.2"), "never overwritten");
    }

    #[test]
    fn an_address_without_connections_is_refused_in_a_certificate() {
        for address in ["10.0.0.1", "fe80::1", "kestrel.local", "drone_2"] {
            assert!(parameters("drone", &[address.to_owned()], 30).is_ok(), "{address}");
        }
        for address in ["foo bar", "", "10.0.0.1:7448", "http://drone", "dr\u{f6}hne"] {
            refused(parameters("drone", &[address.to_owned()], 30), "invalid address");
        }
    }

    #[test]
    fn a_list_of_holders_keeps_its_mode_and_owner() {
        use std::os::unix::fs::chown;
        let home = tempfile::tempdir().unwrap();
        let here = home.path();
        init(here, 30).unwrap();
        issue_for(Role::Operator, Some("bob"), here, here).unwrap();
        let path = here.join(HOLDERS);
        let mode = || fs::metadata(&path).unwrap().permissions().mode() & 0o777;
        assert_eq!(mode(), 0o644, "it holds no secret");
        fs::set_permissions(&path, Permissions::from_mode(0o664)).unwrap();
        // Only some users may give a file away.
        let is_given = chown(&path, Some(12_345), Some(12_346)).is_ok();
        issue_for(Role::Observer, None, here, here).unwrap();
        assert_eq!(mode(), 0o664);
        if is_given {
            let written = fs::metadata(&path).unwrap();
            assert_eq!((written.uid(), written.gid()), (12_345, 12_346));
        }
        revoke(&"operator.bob@drone".parse().unwrap(), here).unwrap();
        assert_eq!(mode(), 0o664);
    }

    #[test]
    fn a_revoked_holder_stays_out() {
        let home = tempfile::tempdir().unwrap();
        let (here, laptop) = (home.path(), home.path().join("laptop"));
        init(here, 30).unwrap();
        issue_for(Role::Operator, Some("bob"), &laptop, here).unwrap();
        let bob: Holder = "operator.bob@drone".parse().unwrap();
        let written = fs::read_to_string(revoke(&bob, here).unwrap()).unwrap();
        assert!(written.contains("\nrevoked operator.bob@drone\n"), "{written}");
        let again = home.path().join("again");
        refused(issue_for(Role::Operator, Some("bob"), &again, here), "was revoked");
        refused(revoke(&"operator.eve@drone".parse().unwrap(), here), "no key was issued");
        issue_for(Role::Observer, None, here, here).unwrap();
        let of_laptop = list(&laptop).unwrap().table();
        // The laptop's list is of the time before.
        let lines: Vec<_> = of_laptop.lines().collect();
        assert!(lines[1].starts_with("operator.bob@drone  yes          operator.pem, expires in "));
        let mut early = list(&laptop).unwrap();
        assert!(!early.holders[0].is_not_valid_yet);
        early.holders[0].is_not_valid_yet = true;
        let expected = "operator.bob@drone  yes          operator.pem, not valid yet: is this machine's clock right?";
        assert_eq!(early.table().lines().nth(1), Some(expected));
        let of_home = list(here).unwrap().table();
        let lines: Vec<_> = of_home.lines().collect();
        assert!(lines[1].starts_with("observer@drone      yes          observer.pem, expires in "));
        assert_eq!(lines[2], "operator.bob@drone  no, revoked  -");
        issue_for(Role::Operator, Some("bobby"), &again, here).unwrap();
        let copied = fs::read_to_string(again.join(HOLDERS)).unwrap();
        assert!(copied.contains("\nrevoked operator.bob@drone\n"), "{copied}");
        fs::write(here.join(HOLDERS), "").unwrap();
        let unlisted = list(here).unwrap().table();
        assert!(unlisted.contains("observer@drone  no, not in holders.txt"), "{unlisted}");
        refused(list(&here.join("none")), "alight keys issue");
    }
}
