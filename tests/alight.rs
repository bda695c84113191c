//! The program `alight`, built for the tests of this package.

fn main() -> std::process::ExitCode {
    alight::main()
}
