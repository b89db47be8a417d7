// table.mjs - prints a package's table of functions, classes and members for its README, from TSDoc: node web/table.mjs reader.
// SPDX-License-Identifier: Apache-2.0
import { fileURLToPath } from "node:url";
import ts from "typescript";

/** The entry that applications import. */
const kEntries = { reader: "reader/src/web.ts", playcanvas: "playcanvas/src/index.ts", spark: "spark/src/index.ts" };

const web = fileURLToPath(new URL(".", import.meta.url));

/** A program of files in web/, with a package's tsconfig.json. `virtual`: texts by path, of files that are not there. */
export function programOf(name, paths, virtual = new Map()) {
  const at = (path) => web + path;
  const { options } = ts.parseJsonConfigFileContent(ts.readConfigFile(at(`${name}/tsconfig.json`), ts.sys.readFile).config, ts.sys, at(name));
  // The reader's sources: its build need not be there.
  const reader = { "@roofgs/reader": [at(kEntries.reader)] };
  const settings = { ...options, noEmit: true, rootDir: web, paths: reader };
  const host = ts.createCompilerHost(settings);
  const texts = new Map([...virtual].map(([path, text]) => [at(path), text]));
  const { fileExists, readFile } = host;
  host.fileExists = (path) => texts.has(path) || fileExists(path);
  host.readFile = (path) => texts.get(path) ?? readFile(path);
  host.getSourceFile = (path, version) => {
    const text = host.readFile(path);
    return text === undefined ? undefined : ts.createSourceFile(path, text, version, true);
  };
  return ts.createProgram(paths.map(at), settings, host);
}

/** What a package exports: { name, kind, returns, text, members }, text being the TSDoc. */
export function exportsOf(name) {
  const program = programOf(name, [kEntries[name]]);
  const checker = program.getTypeChecker();
  const textOf = (symbol) => ts.displayPartsToString(symbol.getDocumentationComment(checker)).replace(/\s+/g, " ");
  const isInner = (declaration) =>
    ts.getCombinedModifierFlags(declaration) & ts.ModifierFlags.Private || ts.getJSDocTags(declaration).some(({ tagName }) => tagName.text === "internal");
  const returnsOf = (declaration) =>
    declaration.type?.getText() ?? (ts.isPropertyDeclaration(declaration) ? checker.typeToString(checker.getTypeAtLocation(declaration)) : "");
  const described = (symbol, declaration) => {
    const parameters = declaration.parameters?.map((p) => p.name.getText() + (p.initializer || p.questionToken ? "?" : ""));
    const called = parameters && !ts.isGetAccessor(declaration) ? `(${parameters.join(", ")})` : "";
    return { name: symbol.name + called, kind: ts.SyntaxKind[declaration.kind], returns: returnsOf(declaration), text: textOf(symbol) };
  };
  const membersOf = (declaration) => {
    if (!ts.isClassDeclaration(declaration) && !ts.isInterfaceDeclaration(declaration)) return [];
    const isShown = (member) => member.name && !isInner(member) && !ts.hasOverrideModifier(member);
    const made = declaration.members.find((member) => ts.isConstructorDeclaration(member) && !isInner(member));
    const shown = declaration.members.filter(isShown).map((member) => described(checker.getSymbolAtLocation(member.name), member));
    return made ? [{ ...described({ name: "", getDocumentationComment: () => made.symbol.getDocumentationComment(checker) }, made) }, ...shown] : shown;
  };
  const module = checker.getSymbolAtLocation(program.getSourceFile(program.getRootFileNames()[0]));
  return checker.getExportsOfModule(module).flatMap((symbol) => {
    const origin = symbol.flags & ts.SymbolFlags.Alias ? checker.getAliasedSymbol(symbol) : symbol;
    const [declaration] = origin.declarations;
    // Not what comes from another package.
    if (!declaration.getSourceFile().fileName.startsWith(`${web}${name}/`)) return [];
    return [{ ...described(origin, declaration), members: membersOf(declaration) }];
  });
}

/** Functions, then classes with their members; the first sentence of each. */
export function tableOf(name) {
  const sentence = (text) => text.replace(/(?<=\.) (?=[A-Z`]).*/, "").replace(/\.$/, "");
  const row = (call, { returns, text }) => `| ${call} | ${returns && `\`${returns.replaceAll("|", "\\|")}\``} | ${sentence(text)} |`;
  const all = exportsOf(name);
  const rows = all.filter(({ kind }) => kind === "FunctionDeclaration").map((one) => row(`\`${one.name}\``, one));
  for (const one of all.filter(({ kind }) => kind === "ClassDeclaration")) {
    rows.push(row(`**${one.name}**`, one));
    for (const member of one.members) rows.push(row(`\`${member.name.startsWith("(") ? `new ${one.name}` : ""}${member.name}\``, member));
  }
  return ["| call | gives | |", "|---|---|---|", ...rows, ""].join("\n");
}

if (process.argv[1] === fileURLToPath(import.meta.url)) process.stdout.write(tableOf(process.argv[2]));
