//! The program `alight`: all of it is in the library of the same name, so that the tests of the whole system
//! build it too.

fn main() -> std::process::ExitCode {
    alight::main()
}
