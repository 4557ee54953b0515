//! Lines about several photographs.

use std::path::Path;

/// Photographs from which on a line about each becomes one about all.
const GROUP: usize = 3;

/// Joins the warnings of photographs, each with the path of its photograph in front: a warning of three or more is one line with
/// their number.
pub fn grouped<'a>(photographs: impl IntoIterator<Item = (&'a Path, &'a [String])>) -> Vec<String> {
    // In the order of the first photograph of each reason.
    let mut groups: Vec<(&str, Vec<&str>)> = Vec::new();
    let mut count = 0;
    for (path, warnings) in photographs {
        count += 1;
        let prefix = format!("{}: ", path.display());
        for warning in warnings {
            let reason = warning.strip_prefix(&prefix).unwrap_or(warning);
            match groups.iter_mut().find(|(other, _)| *other == reason) {
                Some((_, lines)) => lines.push(warning),
                None => groups.push((reason, vec![warning])),
            }
        }
    }
    let line = |(reason, lines): (&str, Vec<&str>)| match lines.len() {
        n if n >= GROUP => vec![format!("{n} of {count} photographs: {reason}")],
        _ => lines.into_iter().map(str::to_owned).collect(),
    };
    groups.into_iter().flat_map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warnings_of_many_photographs_are_one_line() {
        let paths = ["a.heic", "b.heic", "c.png", "d.heic"].map(Path::new);
        let warnings: Vec<Vec<String>> = paths
            .iter()
            .map(|path| match path.extension() {
                Some(e) if e == "png" => vec!["c.png: dark".to_owned(), "no path".to_owned()],
                _ => vec![format!("{}: converted", path.display())],
            })
            .collect();
        let all = || paths.iter().copied().zip(warnings.iter().map(Vec::as_slice));
        assert_eq!(grouped(all()), ["3 of 4 photographs: converted", "c.png: dark", "no path"]);
        assert_eq!(grouped(all().take(2)), ["a.heic: converted", "b.heic: converted"]);
        assert!(grouped([]).is_empty());
    }
}
