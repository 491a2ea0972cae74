//! `rtnet completions` and `rtnet man`: from the same definitions as `--help`.

use std::fs;
use std::path::Path;

use anyhow::Context;
use clap::CommandFactory;
use clap_complete::Shell;

use super::Failure;
use crate::cli::Cli;
use crate::remedy::explained;

/// Prints the completions for a shell.
pub fn completions(shell: Shell) -> Result<u8, Failure> {
    let mut text = Vec::new();
    clap_complete::generate(shell, &mut Cli::command(), "rtnet", &mut text);
    // Whoever closed our output does not want to read the rest.
    let _ = std::io::Write::write_all(&mut std::io::stdout(), &text);
    Ok(0)
}

/// Writes a manual page for the command and for each of its verbs.
pub fn man(directory: &Path) -> Result<u8, Failure> {
    let made = fs::create_dir_all(directory);
    made.map_err(explained)
        .with_context(|| format!("{} cannot be made", directory.display()))
        .map_err(Failure::Usage)?;
    let written = clap_mangen::generate_to(Cli::command(), directory);
    written
        .map_err(explained)
        .with_context(|| format!("{} cannot be written to", directory.display()))
        .map_err(Failure::Usage)?;
    Ok(0)
}
