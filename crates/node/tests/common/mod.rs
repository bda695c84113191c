//! Keys for tests: a site's authority, and the certificates that it issues.

use std::fs::{OpenOptions, Permissions};
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use node::access::{HOLDERS, Holder};
use node::network::AUTHORITY;
use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa,
    Issuer, KeyPair, KeyUsagePurpose,
};

/// A certificate authority.
pub(crate) struct Authority {
    pem: String,
    issuer: Issuer<'static, KeyPair>,
}

impl Authority {
    pub(crate) fn new() -> anyhow::Result<Self> {
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        let key = KeyPair::generate()?;
        let pem = params.self_signed(&key)?.pem();
        Ok(Self { issuer: Issuer::from_ca_cert_pem(&pem, key)?, pem })
    }

    /// Writes the key of a holder, its certificate and that of the authority.
    pub(crate) fn issue(&self, folder: &Path, holder: &str) -> anyhow::Result<()> {
        let holder: Holder = holder.parse()?;
        let mut params = CertificateParams::new(vec!["127.0.0.1".to_owned()])?;
        params.distinguished_name = DistinguishedName::new();
        params.distinguished_name.push(DnType::CommonName, holder.to_string());
        params.use_authority_key_identifier_extension = true;
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ClientAuth, ExtendedKeyUsagePurpose::ServerAuth];
        let key = KeyPair::generate()?;
        let certificate = params.signed_by(&key, &self.issuer)?;
        std::fs::write(folder.join(AUTHORITY), &self.pem)?;
        let name = holder.key_name();
        let private = folder.join(format!("{name}.key"));
        std::fs::write(&private, key.serialize_pem())?;
        std::fs::set_permissions(private, Permissions::from_mode(0o600))?;
        std::fs::write(folder.join(format!("{name}.pem")), certificate.pem())?;
        Ok(())
    }
}

/// Adds a line to the list of holders next to the relay's key.
pub(crate) fn list(folder: &Path, line: &str) -> anyhow::Result<()> {
    let mut list = OpenOptions::new().create(true).append(true).open(folder.join(HOLDERS))?;
    writeln!(list, "{line}")?;
    Ok(())
}
