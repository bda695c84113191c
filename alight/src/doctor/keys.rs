//! `alight doctor` on keys: certificates, private keys, authority and list of holders of the site's processes and of the operator:
//! missing, expired, of another vehicle, or readable by others.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use node::Network;
use node::access::{HOLDERS, Holder, Holders};
use node::certificate::{Certificate, certificate, is_signed_by};
use node::network::{AUTHORITY, check_pair, check_private, issue_arguments};

use super::Findings;
use crate::args::OPERATOR;
use crate::site::Job;

/// Certificates that expire within this time are reported, in seconds.
const EXPIRES_SOON_S: i64 = 30 * DAY_S;
const DAY_S: i64 = 86_400;
const COPY_HOLDERS: &str =
    "copy it from the authority's folder again, and restart the processes that read it";
const COPY_BOTH: &str = "copy certificate and key from one `alight keys issue`";

/// The files that were checked already, so that each is reported once.
#[derive(Default)]
pub(super) struct Checked {
    keys: BTreeSet<(PathBuf, String)>,
    authorities: BTreeSet<PathBuf>,
    vehicles: BTreeSet<(PathBuf, String)>,
}

impl Checked {
    /// Checks the key of a process of the site, if it needs one.
    pub(super) fn process(&mut self, findings: &mut Findings, job: &Job) {
        if job.needs_key() {
            self.key(findings, &job.network, &job.key);
        }
    }

    /// Checks the key of the operator, with which `alight command` and `alight doctor` join the network.
    pub(super) fn operator(&mut self, findings: &mut Findings, network: &Network) {
        self.key(findings, network, OPERATOR);
    }

    /// Checks the files of a network's key by their name.
    fn key(&mut self, findings: &mut Findings, network: &Network, name: &str) {
        let Some(keys) = network.keys.as_deref() else { return };
        // An error in the network's file is reported where the network is joined.
        let Ok(vehicle) = network.vehicle_name() else { return };
        let vehicle = vehicle.as_str();
        if !self.keys.insert((keys.to_owned(), name.to_owned())) {
            return;
        }
        let files = [AUTHORITY.to_owned(), format!("{name}.pem"), format!("{name}.key")];
        let is_denied = |path: &PathBuf| {
            File::open(path).is_err_and(|cause| cause.kind() == ErrorKind::PermissionDenied)
        };
        if let Some(denied) = files.map(|file| keys.join(file)).iter().find(|it| is_denied(it)) {
            findings.doubtful(
                "keys",
                format!(
                    "the key `{name}` was not checked: this user may not read {}",
                    denied.display()
                ),
                "run this as the user that runs the services: `sudo -u USER alight doctor ...`",
            );
            return;
        }
        if self.authorities.insert(keys.to_owned()) {
            check_authority(findings, &keys.join(AUTHORITY));
        }
        let is_there = ["pem", "key"].map(|end| keys.join(format!("{name}.{end}")).exists());
        if is_there == [false; 2] {
            let place = keys.display();
            let text = format!("there is no key `{name}` in {place}{}", without(name));
            findings.wrong("keys", text, &issue(name, vehicle));
        } else {
            check_certificate(findings, keys, name, vehicle);
            check_key(findings, keys, name, vehicle);
        }
        if self.vehicles.insert((keys.to_owned(), vehicle.to_owned())) {
            check_holders(findings, keys, vehicle);
        }
    }
}

/// How to make a key and its certificate.
fn issue(name: &str, vehicle: &str) -> String {
    let arguments = issue_arguments(name);
    format!(
        "make it where the authority is, into a new directory (`alight keys issue {arguments} --vehicle {vehicle} --authority DIR -o NEW`), \
         and copy it here"
    )
}

/// The consequence of a missing key.
fn without(name: &str) -> &'static str {
    match name {
        OPERATOR => ": without it this machine can neither command nor see what runs on the drone",
        _ => "",
    }
}

fn check_authority(findings: &mut Findings, path: &Path) {
    let again = "copy it again from where `alight keys init` made it";
    match certificate(path) {
        Err(problem) => findings.wrong("keys", format!("the authority: {problem:#}"), again),
        Ok(read) => report_validity(findings, &read, "the authority", path, "make a new authority"),
    }
}

/// Reports whether a certificate is valid now, and for how long.
fn report_validity(
    findings: &mut Findings,
    read: &Certificate,
    subject: &str,
    path: &Path,
    again: &str,
) {
    let path = path.display();
    if read.begins_in_s > 0 {
        let days = read.begins_in_s.unsigned_abs().div_ceil(DAY_S.unsigned_abs());
        findings.wrong(
            "keys",
            format!(
                "{subject} is not valid yet, for {days} days more: the clock of this machine is behind, or that of the machine that made \
                 it was ahead: {path}"
            ),
            "set the clock (`timedatectl` shows it, and whether NTP keeps it), then run this again",
        );
        return;
    }
    let days = read.expires_in_s.unsigned_abs() / DAY_S.unsigned_abs();
    match read.expires_in_s {
        ..0 => findings.wrong(
            "keys",
            format!(
                "{subject} has expired {days} days ago, or the clock of this machine is wrong: {path}"
            ),
            again,
        ),
        0..EXPIRES_SOON_S => {
            findings.doubtful("keys", format!("{subject} expires in {days} days: {path}"), again);
        }
        _ => findings.good("keys", format!("{subject} is valid for {days} days: {path}")),
    }
}

/// Checks a certificate: its holder, its vehicle, whether the authority has signed it, and whether the list of holders names it.
fn check_certificate(findings: &mut Findings, keys: &Path, name: &str, vehicle: &str) {
    let path = keys.join(format!("{name}.pem"));
    let file = path.display();
    let again = issue(name, vehicle);
    let read = match certificate(&path) {
        Ok(read) => read,
        Err(problem) => {
            findings.wrong("keys", format!("the key `{name}`: {problem:#}"), &again);
            return;
        }
    };
    let holder = match read.common_name.parse::<Holder>() {
        Ok(holder) if holder.key_name() == name => holder,
        _ => {
            let text = format!("{file} is of `{}`, not of a `{name}`", read.common_name);
            findings.wrong("keys", text, "keep the file names of `alight keys issue`");
            return;
        }
    };
    if holder.vehicle() != vehicle {
        findings.wrong(
            "keys",
            format!(
                "{file} is of `{holder}`, and the vehicle here is `{vehicle}`, which refuses it"
            ),
            &format!("correct `vehicle` in the site, or {again}"),
        );
        return;
    }
    match is_signed_by(&path, &keys.join(AUTHORITY)) {
        Ok(true) => {
            let subject = format!("the key of `{holder}`, signed by the authority here,");
            report_validity(findings, &read, &subject, &path, &again);
        }
        Ok(false) => findings.wrong(
            "keys",
            format!("{file} is not signed by the authority whose certificate is in the same directory, so no process accepts it"),
            "copy all files from one directory of `alight keys issue`, of one authority",
        ),
        // That the authority's certificate cannot be read was reported above.
        Err(_) => {}
    }
    let listed = std::fs::read_to_string(keys.join(HOLDERS)).ok();
    if let Some(holders) = listed.and_then(|text| text.parse::<Holders>().ok())
        && !holders.admits(&holder)
    {
        let list = keys.join(HOLDERS);
        findings.wrong(
            "keys",
            format!("{} does not name `{holder}`, or names it as revoked: it is refused", list.display()),
            "copy the list from the authority's folder again; a revoked key stays out, and another `--name` is let in",
        );
    }
}

/// Checks a private key: whether it is there, for this user alone, and belongs to its certificate.
fn check_key(findings: &mut Findings, keys: &Path, name: &str, vehicle: &str) {
    let path = keys.join(format!("{name}.key"));
    let file = path.display();
    match File::open(&path) {
        Err(cause) if cause.kind() == ErrorKind::NotFound => {
            let text = format!("{file} does not exist{}", without(name));
            findings.wrong("keys", text, &issue(name, vehicle));
            return;
        }
        Err(cause) => {
            findings.wrong("keys", format!("{file} cannot be read: {cause}"), COPY_BOTH);
            return;
        }
        Ok(_) => {}
    }
    if let Err(problem) = check_private(&path) {
        findings.wrong("keys", format!("{problem:#}"), "run the command, then this again");
    }
    let has_certificates = [AUTHORITY.to_owned(), format!("{name}.pem")]
        .iter()
        .all(|file| certificate(&keys.join(file)).is_ok());
    if has_certificates && let Err(problem) = check_pair(keys, name) {
        findings.wrong("keys", format!("{problem:#}"), COPY_BOTH);
    }
}

/// Checks that a list of holders among the keys names the drone: processes with an older list refuse its relay.
fn check_holders(findings: &mut Findings, keys: &Path, vehicle: &str) {
    let path = keys.join(HOLDERS);
    let text = match std::fs::read_to_string(&path) {
        Ok(text) => text,
        // A missing list that is needed is reported where the network is joined.
        Err(cause) if cause.kind() == ErrorKind::NotFound => return,
        Err(cause) => {
            let file = path.display();
            findings.wrong(
                "keys",
                format!("{file} cannot be read ({cause}), so changes of it, such as a revoked holder, have no effect"),
                &format!("it holds no secret: `sudo chmod 644 {file}`, or {COPY_HOLDERS}"),
            );
            return;
        }
    };
    match text.parse::<Holders>() {
        Err(problem) => {
            findings.wrong("keys", format!("{}: {problem:#}", path.display()), COPY_HOLDERS);
        }
        Ok(holders) if !holders.has("drone", vehicle) => findings.wrong(
            "keys",
            format!("{} does not name `drone@{vehicle}`, which is refused", path.display()),
            COPY_HOLDERS,
        ),
        Ok(_) => {}
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;
    use crate::keys::make_for_tests;

    fn network(keys: &Path, vehicle: Option<&str>) -> Network {
        let vehicle = vehicle.map(str::to_owned);
        Network { keys: Some(keys.to_owned()), vehicle, ..Network::default() }
    }

    /// The findings on the operator's key in a folder.
    fn findings_text(keys: &Path) -> String {
        let mut findings = Findings::default();
        Checked::default().operator(&mut findings, &network(keys, None));
        findings.text()
    }

    #[test]
    fn the_operators_key_is_reported_with_its_holder_and_its_errors() {
        let folder = tempfile::tempdir().unwrap();
        let [here, other] = ["here", "other"].map(|name| folder.path().join(name));
        for keys in [&here, &other] {
            make_for_tests(keys, &[]).unwrap();
        }
        let good = findings_text(&here);
        assert!(good.ends_with("Nothing is wrong."), "{good}");
        let valid = "the key of `operator@drone`, signed by the authority here, ";
        assert!(good.contains(valid), "{good}");
        let file = |name: &str| here.join(name);
        let copy = |from: &Path, name: &str| {
            std::fs::copy(from, file(name)).unwrap();
        };
        let changes: [(&str, &dyn Fn(), &str); 8] = [
            (
                "another authority",
                &|| copy(&other.join(AUTHORITY), AUTHORITY),
                "is not signed by the authority",
            ),
            ("another key", &|| copy(&file("observer.key"), "operator.key"), "does not belong to"),
            (
                "another certificate",
                &|| copy(&file("observer.pem"), "operator.pem"),
                "is of `observer@drone`, not of a `operator`",
            ),
            (
                "open to others",
                &|| {
                    let open = std::fs::Permissions::from_mode(0o644);
                    std::fs::set_permissions(file("operator.key"), open).unwrap();
                },
                "chmod 600",
            ),
            (
                "no key",
                &|| std::fs::remove_file(file("operator.key")).unwrap(),
                "can neither command nor see",
            ),
            (
                "no certificate",
                &|| std::fs::remove_file(file("operator.pem")).unwrap(),
                "alight keys issue --role operator --vehicle drone",
            ),
            (
                "neither",
                &|| {
                    for end in ["key", "pem"] {
                        std::fs::remove_file(file(&format!("operator.{end}"))).unwrap();
                    }
                },
                "there is no key `operator` in",
            ),
            (
                "revoked",
                &|| {
                    let list = std::fs::read_to_string(file(HOLDERS)).unwrap();
                    let list = list.replace("operator@", "revoked operator@");
                    std::fs::write(file(HOLDERS), list).unwrap();
                },
                "does not name `operator@drone`, or names it as revoked",
            ),
        ];
        for (name, change, part) in changes {
            change();
            let text = findings_text(&here);
            assert!(text.contains(part) && text.contains("WRONG"), "{name}: {text}");
            std::fs::remove_dir_all(&here).unwrap();
            make_for_tests(&here, &[]).unwrap();
        }
    }

    #[test]
    fn a_list_of_holders_that_cannot_be_read_is_reported() {
        let folder = tempfile::tempdir().unwrap();
        make_for_tests(folder.path(), &[]).unwrap();
        let list = folder.path().join(HOLDERS);
        // The user of the tests may be allowed to read any file (root), but a directory is not a file.
        std::fs::remove_file(&list).unwrap();
        let without = findings_text(folder.path());
        assert!(without.ends_with("Nothing is wrong."), "{without}");
        std::fs::create_dir(&list).unwrap();
        let text = findings_text(folder.path());
        for part in ["WRONG", "holders.txt cannot be read", "have no effect", "chmod 644"] {
            assert!(text.contains(part), "`{part}` is not in: {text}");
        }
    }

    #[test]
    fn a_key_of_another_vehicle_is_refused_there() {
        let folder = tempfile::tempdir().unwrap();
        make_for_tests(folder.path(), &[]).unwrap();
        let mut findings = Findings::default();
        Checked::default().operator(&mut findings, &network(folder.path(), Some("kestrel")));
        let text = findings.text();
        let part = "is of `operator@drone`, and the vehicle here is `kestrel`, which refuses it";
        assert!(text.contains(part), "{text}");
        // A file of the user's own names it as well.
        let file = folder.path().join("zenoh.json5");
        let own =
            node::session::LOCAL_CONFIG.replace("namespace: \"drone\"", "namespace: \"kestrel\"");
        std::fs::write(&file, own).unwrap();
        let mut findings = Findings::default();
        let own = Network { config: Some(file), ..network(folder.path(), None) };
        Checked::default().operator(&mut findings, &own);
        assert!(findings.text().contains(part), "{}", findings.text());
    }

    #[test]
    fn a_certificate_that_is_not_valid_yet_is_reported_with_the_clock() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(AUTHORITY);
        let mut params = rcgen::CertificateParams::default();
        params.not_before = rcgen::date_time_ymd(3000, 1, 1);
        params.not_after = rcgen::date_time_ymd(3010, 1, 1);
        let key = rcgen::KeyPair::generate().unwrap();
        std::fs::write(&path, params.self_signed(&key).unwrap().pem()).unwrap();
        let mut findings = Findings::default();
        check_authority(&mut findings, &path);
        let text = findings.text();
        for part in ["WRONG", "the authority is not valid yet", "the clock of this machine"] {
            assert!(text.contains(part), "`{part}` is not in: {text}");
        }
        assert!(text.contains("timedatectl") && !text.contains("make a new"), "{text}");
    }

    #[test]
    fn a_certificate_that_ends_soon_or_has_ended_is_reported() {
        let findings_text = |expires_in_s| {
            let mut findings = Findings::default();
            let begins_in_s = -DAY_S;
            let read = Certificate { common_name: String::new(), begins_in_s, expires_in_s };
            report_validity(&mut findings, &read, "the key", Path::new("x.pem"), "again");
            findings.text()
        };
        assert!(
            findings_text(400 * DAY_S)
                .contains("ok     keys          the key is valid for 400 days")
        );
        assert!(
            findings_text(3 * DAY_S).contains("?      keys          the key expires in 3 days")
        );
        assert!(
            findings_text(-3 * DAY_S)
                .contains("WRONG  keys          the key has expired 3 days ago")
        );
    }
}
