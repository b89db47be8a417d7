// readme.test.mjs - the packages' READMEs: their tables are what table.mjs prints, their examples have types, and everything has TSDoc.
// SPDX-License-Identifier: Apache-2.0
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import ts from "typescript";
import { exportsOf, programOf, tableOf } from "../../table.mjs";

for (const name of ["reader", "playcanvas", "spark"]) {
  const readme = readFileSync(new URL(`../../${name}/README.md`, import.meta.url), "utf8");

  test(`the README of ${name}`, async (t) => {
    await t.test("has the table of all calls", () => {
      assert.equal(readme.match(/(^\|.*\n)+/m)[0], tableOf(name), `node web/table.mjs ${name} prints it`);
    });

    await t.test("has examples that strict TypeScript takes", () => {
      const blocks = readme.match(/(?<=\n\n)( {4}.*\n|\n(?= {4}))+/g).filter((block) => /^ {4}import /.test(block));
      assert.ok(blocks.length > 0);
      const files = new Map(blocks.map((block, i) => [`${name}/README.${i}.ts`, block.replace(/^ {4}/gm, "")]));
      const program = programOf(name, [...files.keys()], files);
      const said = ts.getPreEmitDiagnostics(program).map(({ file, start, messageText }) => {
        const line = file ? file.text.slice(0, start).split("\n").at(-1) + file.text.slice(start).split("\n")[0] : "";
        return `${line.trim()}: ${ts.flattenDiagnosticMessageText(messageText, "\n")}`;
      });
      assert.deepEqual(said, []);
    });
  });

  test(`all that ${name} exports has TSDoc, and so have all members of its classes`, () => {
    const all = exportsOf(name).flatMap((one) => [one, ...(one.kind === "ClassDeclaration" ? one.members : [])]);
    assert.ok(all.length > 2);
    assert.deepEqual(all.filter(({ text }) => !text).map((one) => one.name), []);
  });
}
