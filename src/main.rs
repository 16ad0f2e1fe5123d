//! The `smoke` command: see `smoke --help`.

fn main() -> std::process::ExitCode {
    bevy_smoke::cli::main()
}
